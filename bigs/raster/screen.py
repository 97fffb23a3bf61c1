"""Centres on screen as a tensor of the graph: what densification strategies read gradients from."""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable


def centres(
    values: torch.Tensor,  # [..., C, N, 2]
    seen: torch.Tensor,  # [..., C, N] bool
    means: torch.Tensor,  # [..., N, 3]
    viewmats: torch.Tensor,  # [..., C, 4, 4]
    Ks: torch.Tensor,  # [..., C, 3, 3]
    camera_model: str,
) -> torch.Tensor:
    """The projected centres of what is seen, [nnz, 2], as a function of means and viewmats.

    The engine renders in one piece and would not need them. Put between the Gaussians and the image they
    receive a part of the image's gradient as a tensor of their own, and pass it on.
    """
    return _Centres.apply(values[seen], seen, Ks, camera_model, means, viewmats)


def everywhere(packed: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Packed centres [nnz, 2] with zeros where nothing is seen, [*seen, 2]."""
    full = packed.new_zeros(*seen.shape, 2)
    return full.index_put((seen,), packed)


def depth_of(
    ids: torch.Tensor,  # [..., C, H, W] of Gaussians, −1 for none
    means: torch.Tensor,  # [..., N, 3]
    viewmats: torch.Tensor,  # [..., C, 4, 4]
) -> torch.Tensor:
    """Camera z of the Gaussian named in each pixel, [..., C, H, W, 1]; 0 for none."""
    if means.shape[-2] == 0:
        return means.new_zeros(*ids.shape, 1)
    depths = (means[..., None, :, :] * viewmats[..., 2, None, :3]).sum(-1) + viewmats[..., 2, None, 3]
    flat = ids.reshape(*ids.shape[:-2], -1).long()
    picked = depths.expand(*flat.shape[:-1], depths.shape[-1]).gather(-1, flat.clamp_min(0))
    return torch.where(flat >= 0, picked, 0.0).reshape(*ids.shape, 1)


class _Centres(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        packed: torch.Tensor,
        seen: torch.Tensor,
        Ks: torch.Tensor,
        camera_model: str,
        means: torch.Tensor,
        viewmats: torch.Tensor,
    ) -> torch.Tensor:
        ctx.save_for_backward(seen, Ks, means, viewmats)
        ctx.camera_model = camera_model
        return packed.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_packed: torch.Tensor) -> tuple:
        seen, Ks, *inputs = ctx.saved_tensors
        wanted = ctx.needs_input_grad[4:]
        with torch.enable_grad():
            means, viewmats = (
                x.detach().requires_grad_(want) for x, want in zip(inputs, wanted, strict=True)
            )
            points = means[..., None, :, :] @ viewmats[..., :3, :3].mT + viewmats[..., None, :3, 3]
            points = points.expand(*seen.shape, 3)[seen]
            focal = torch.diagonal(Ks[..., :2, :2], dim1=-2, dim2=-1)[..., None, :]
            focal = focal.expand(*seen.shape, 2)[seen]
            # The principal point has no effect here.
            centres = focal * points[:, :2]
            if ctx.camera_model == "pinhole":
                centres = centres / points[:, 2:]
            leaves = [x for x, want in zip((means, viewmats), wanted, strict=True) if want]
            gradients = iter(torch.autograd.grad(centres, leaves, v_packed))
        return None, None, None, None, *(next(gradients) if want else None for want in wanted)
