"""What silhouettes say: nothing outside the foreground, and each subject where its mask is."""

from __future__ import annotations

import torch
from torch import Tensor


def outside_mask(pred: Tensor, foreground: Tensor) -> Tensor:
    """The paper's mask regulariser |(1 - m) I_pred| (Eq. 5), a mean over the outside's pixels and channels.

    Args:
        pred: [..., D], rendered on black.
        foreground: [...] in [0, 1], union of all subjects' masks.
    """
    outside = 1.0 - foreground
    return (pred.abs() * outside[..., None]).sum() / (outside.sum() * pred.shape[-1]).clamp_min(1.0)


def alpha_outside_masks(alphas: Tensor, empty: Tensor, foreground: Tensor) -> Tensor:
    """Sum of e A^2 over the sum of m: squared alpha A where nothing is (e), per pixel of the masks m.

    A mean over the outside would count a pixel there the less the more of them there are, and Gaussians that
    may grow would rather glow beyond an outline than miss it. Colour would let black ones stand anywhere.

    Args:
        alphas: [M, 1] rendered.
        empty: [M] in [0, 1], the share of each pixel that should show nothing.
        foreground: [M] in [0, 1], union of all subjects' masks.
    """
    return (alphas.square() * empty[:, None]).sum() / foreground.sum().clamp_min(1.0)


def outside_mask_on(colors: Tensor, alphas: Tensor, foreground: Tensor, generator: torch.Generator) -> Tensor:
    """`outside_mask` over a background of one random colour b, as in the released code: |I_pred - b| outside.

    On black a Gaussian outside costs as much as it is bright; over a colour that changes from step to step
    there is no colour to hide in. What is rendered on black becomes C + (1 - A) b, so the difference from b
    is C - A b.

    Args:
        colors: [B, H, W, 3], rendered on black.
        alphas: [B, H, W, 1].
        foreground: as in `outside_mask`.
        generator: draws b.
    """
    background = torch.rand(3, generator=generator)
    return outside_mask(colors - alphas * background, foreground)


def amodal_silhouette(alpha: Tensor, own: Tensor, hidden: Tensor) -> Tensor:
    """One subject, rendered alone, against its own visible mask; where others may hide it, anything goes.

    A pixel whose area belongs to the subject by `own` and to possible occluders by `hidden` allows any alpha
    between `own` and `own + hidden`. Squared excess, summed over pixels, per pixel of the subject.

    Args:
        alpha: [B, H, W] rendered coverage.
        own: [B, H, W] visible share of each pixel in [0, 1].
        hidden: [B, H, W] share in which the subject may be hidden.
    """
    # The nearest allowed alpha is alpha itself where nothing is wrong and a constant elsewhere: detached, it
    # gives the same gradient in half the passes over the images.
    nearest = torch.clamp(alpha.detach(), own, own + hidden)
    return (alpha - nearest).square().sum() / own.sum().clamp_min(1.0)


def label_difference(pred: Tensor, labels: Tensor) -> Tensor:
    """Sum of (pred - labels)^2 over the sum of labels: one joint rendering against the visible masks.

    It sees who hides whom, since a channel is dimmed by all that lies in front of its subject.

    Args:
        pred: [..., E] rendered label channels, one for each of E subjects, in [0, 1].
        labels: [..., E] visible share of each subject in a pixel, in [0, 1].
    """
    return (pred - labels).square().sum() / labels.sum().clamp_min(1.0)
