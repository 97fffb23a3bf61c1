"""How far rendered pictures are from a clip's images and masks: all terms in one pass over the pixels.

The terms are those of `bigs.losses.photometric` and `bigs.losses.mask`, which tests compare with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

import bigs._raster as _raster
from bigs.fused.arrays import array, array_or_none, shaped


class TogetherTerms(NamedTuple):
    """Terms of pictures of all subjects together."""

    image: Tensor  # [] `masked_l1` over the foreground
    mse: Tensor  # [] `masked_mse` over the foreground
    alpha_outside: Tensor  # [] `alpha_outside_masks` where nothing is
    labels: Tensor  # [] `label_difference` of the label channels; 0 without any


class AloneTerms(NamedTuple):
    """Terms of pictures of one subject alone."""

    image: Tensor  # [] `masked_l1` over its own pixels
    mse: Tensor  # [] `masked_mse` over its own pixels
    coverage: Tensor  # [] `amodal_silhouette`


def together_terms(
    colors: Tensor,
    alphas: Tensor,
    images: Tensor,
    foreground: Tensor,
    unknown: Tensor,
    shares: Sequence[Tensor],
    frames: Tensor,
    covered: float,
) -> TogetherTerms:
    """Compare renderings of some frames with a clip, without pixels that something unlabelled covers.

    Args:
        colors: [B, H, W, 3 + E] rendered, with a channel for each label.
        alphas: [B, H, W, 1] rendered.
        images: [T, H, W, 3] of the whole clip.
        foreground: [T, H, W] share of each pixel that shows any subject.
        unknown: [T, H, W] share that something unlabelled covers.
        shares: [T, H, W] for each of the E labels, the share that shows its subject.
        frames: [B] of the T.
        covered: a pixel of which more is unknown does not count.
    """
    clip = (images, foreground, unknown, *shares)
    return TogetherTerms(*_Together.apply(tuple(frames.tolist()), covered, colors, alphas, *clip))


def alone_terms(
    colors: Tensor | None, alphas: Tensor, images: Tensor, own: Tensor, hidden: Tensor, frames: Tensor
) -> AloneTerms:
    """Compare renderings of one subject in some frames with a clip.

    Args:
        colors: [B, H, W, 3] rendered; without them their terms are 0.
        alphas: [B, H, W, 1] rendered.
        images: [T, H, W, 3] of the whole clip.
        own: [T, H, W] share of each pixel that shows the subject.
        hidden: [T, H, W] share in which something may hide it.
        frames: [B] of the T.
    """
    return AloneTerms(*_Alone.apply(tuple(frames.tolist()), alphas, colors, images, own, hidden))


def coverage_squares(alphas: Tensor, own: Tensor, hidden: Tensor, frames: Tensor) -> Tensor:
    """How far [B] a subject's coverage is from what its mask allows: squares, summed over each picture.

    These are the sums that `amodal_silhouette` is a mean of.

    Args:
        alphas: [B, H, W] rendered.
        own: [T, H, W] share of each pixel of the clip that shows the subject.
        hidden: [T, H, W] share in which something may hide it.
        frames: [B] of the T, which may repeat.
    """
    return _CoverageSquares.apply(tuple(frames.tolist()), alphas, own, hidden)


class _Together(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, frames: tuple[int, ...], covered: float, colors: Tensor, alphas: Tensor, *clip: Tensor
    ) -> tuple[Tensor, ...]:
        arrays = tuple(map(array, (colors, alphas, *clip)))
        values, areas = _raster.terms_together(arrays, frames, covered)
        # Saved to notice renderings changed in place before the backward pass; what it reads are the arrays.
        ctx.save_for_backward(colors, alphas)
        ctx.arrays, ctx.frames, ctx.covered, ctx.areas = arrays, frames, covered, areas
        ctx.set_materialize_grads(False)
        return tuple(colors.new_tensor(value) for value in values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor | None) -> tuple:
        colors, alphas = ctx.saved_tensors
        v_colors, v_alphas = _raster.terms_together_backward(
            ctx.arrays, ctx.frames, ctx.covered, ctx.areas, _numbers(pulls)
        )
        clip = [None] * (len(ctx.arrays) - 2)
        return None, None, shaped(v_colors, colors), shaped(v_alphas, alphas), *clip


class _Alone(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, frames: tuple[int, ...], alphas: Tensor, colors: Tensor | None, *clip: Tensor
    ) -> tuple[Tensor, ...]:
        arrays = (array(alphas), array_or_none(colors), *map(array, clip))
        values, area = _raster.terms_alone(arrays, frames)
        ctx.save_for_backward(alphas, colors)
        ctx.arrays, ctx.frames, ctx.area = arrays, frames, area
        ctx.set_materialize_grads(False)
        return tuple(alphas.new_tensor(value) for value in values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor | None) -> tuple:
        alphas, colors = ctx.saved_tensors
        v_colors, v_alphas = _raster.terms_alone_backward(ctx.arrays, ctx.frames, ctx.area, _numbers(pulls))
        return (
            None,
            shaped(v_alphas, alphas),
            None if colors is None else shaped(v_colors, colors),
            None,
            None,
            None,
        )


class _CoverageSquares(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, frames: tuple[int, ...], alphas: Tensor, *masks: Tensor) -> Tensor:
        ctx.arrays, ctx.frames = tuple(map(array, (alphas, *masks))), frames
        ctx.save_for_backward(alphas)
        return alphas.new_tensor(_raster.coverage_squares(ctx.arrays, frames))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, pull: Tensor) -> tuple:
        (alphas,) = ctx.saved_tensors
        found = _raster.coverage_squares_backward(ctx.arrays, ctx.frames, pull.tolist())
        return None, shaped(found, alphas), None, None


def _numbers(pulls: Sequence[Tensor | None]) -> list[float]:
    return [0.0 if pull is None else float(pull) for pull in pulls]
