"""Image similarity: PSNR and SSIM, differentiable. The photometric loss uses the same functions."""

from __future__ import annotations

import torch
from torch.autograd.function import once_differentiable

from bigs.checks import InputError, check_shape

# The stabilisers of the SSIM paper (Wang et al. 2004) for values in [0, 1].
_C1 = 0.01**2
_C2 = 0.03**2


def psnr(pred: torch.Tensor, gt: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
    """Peak signal-to-noise ratio in dB for values in [0, 1]; infinite for equal images.

    One mean squared error per image, over its pixels and channels; then the mean of the images' decibels.

    Args:
        pred: image [B, C, H, W].
        gt: image [B, C, H, W].
        mask: weights [B, H, W] or [B, 1, H, W], boolean or in [0, 1]; pixels of weight 0 are ignored.

    Returns:
        Scalar tensor; NaN when an image's mask is empty.

    Raises:
        InputError: shapes differ.
    """
    weights = _check_images(pred, gt, mask)
    squared = (pred - gt).square().mean(dim=1, keepdim=True)
    mse = squared.mean(dim=(1, 2, 3)) if weights is None else _masked_means(squared, weights)
    return (-10.0 * torch.log10(mse)).mean()


def ssim(
    pred: torch.Tensor,
    gt: torch.Tensor,
    mask: torch.Tensor | None = None,
    window: int = 11,
    sigma: float = 1.5,
) -> torch.Tensor:
    """Mean structural similarity of images with values in [0, 1]; 1 for equal images.

    Args:
        pred: image [B, C, H, W].
        gt: image [B, C, H, W].
        mask: weights [B, H, W] or [B, 1, H, W]: selects pixels of the finished map. It does not blank the
            images, so colours just outside still count through the window; blank both first to avoid that.
        window: side of the Gaussian window in pixels, odd.
        sigma: its standard deviation in pixels.

    Returns:
        Scalar tensor: mean over images of the mean over (selected) pixels and channels.

    Raises:
        InputError: shapes differ, or `window` is even.
    """
    weights = _check_images(pred, gt, mask)
    similarity = ssim_map(pred, gt, window, sigma)
    if weights is None:
        return similarity.mean()
    return _masked_means(similarity.mean(dim=1, keepdim=True), weights).mean()


def ssim_map(pred: torch.Tensor, gt: torch.Tensor, window: int = 11, sigma: float = 1.5) -> torch.Tensor:
    """Structural similarity of every pixel and channel.

    The window sees zeros outside the image, as the splatting field's SSIM losses have it (kornia's mirrors
    the border instead, so only pixels at least `window // 2` from the border agree with it).

    Args:
        pred: image [B, C, H, W], values in [0, 1].
        gt: image [B, C, H, W].
        window: side of the Gaussian window in pixels, odd.
        sigma: its standard deviation in pixels.

    Returns:
        Map [B, C, H, W], at most 1.

    Raises:
        InputError: shapes differ, or `window` is even.
    """
    _check_images(pred, gt, None)
    if window < 1 or window % 2 == 0:
        raise InputError(f"window: expected an odd number of pixels, found {window}")
    return _SsimMap.apply(pred, gt, _gaussian_kernel(window, sigma, pred))


class _SsimMap(torch.autograd.Function):
    """The map and its hand-derived gradient: three quarters of the time that autograd takes.

    With the blurs a = G pred, b = G gt, s = G (pred² + gt²), p = G (pred gt), the map is
    (2ab + C1) (2(p - ab) + C2) / ((a² + b² + C1) (s - a² - b² + C2)). Only the sum of the two second moments
    enters, so four blurs serve where five are usual. G is symmetric: its transpose is the same blur.
    """

    @staticmethod
    def forward(ctx, pred: torch.Tensor, gt: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
        moments = torch.stack((pred, gt, (pred * pred).addcmul_(gt, gt), pred * gt))
        a, b, s, p = _blur(moments.flatten(1, 2), kernel).view_as(moments)
        ab = a * b
        squares = (a * a).addcmul_(b, b)
        luminance_top = (2 * ab).add_(_C1)
        structure_top = p.sub_(ab).mul_(2).add_(_C2)
        luminance_base = squares + _C1
        structure_base = s.sub_(squares).add_(_C2)
        luminance = luminance_top.div_(luminance_base)
        structure = structure_top.div_(structure_base)
        ctx.save_for_backward(pred, gt, kernel, a, b, luminance, structure, luminance_base, structure_base)
        return luminance * structure

    @staticmethod
    @once_differentiable
    def backward(ctx, v_map: torch.Tensor) -> tuple[torch.Tensor | None, torch.Tensor | None, None]:
        pred, gt, kernel, a, b, luminance, structure, luminance_base, structure_base = ctx.saved_tensors
        v_luminance = v_map * structure / luminance_base
        v_structure = v_map * luminance / structure_base
        v_s = -v_structure * structure
        v_p = 2 * v_structure
        # d map / d a = cross * b + own * a, and the same with a and b exchanged
        cross = 2 * (v_luminance - v_structure)
        own = -2 * (v_luminance * luminance + v_s)
        needs_pred, needs_gt, _ = ctx.needs_input_grad
        planes = [v_s, v_p]
        if needs_pred:
            planes.append(own * a + cross * b)
        if needs_gt:
            planes.append(own * b + cross * a)
        blurred = torch.stack(planes)
        v_s, v_p, *v_means = _blur(blurred.flatten(1, 2), kernel).view_as(blurred)
        v_pred = v_means.pop(0).addcmul(pred, v_s, value=2).addcmul_(gt, v_p) if needs_pred else None
        v_gt = v_means.pop(0).addcmul(gt, v_s, value=2).addcmul_(pred, v_p) if needs_gt else None
        return v_pred, v_gt, None


def _gaussian_kernel(window: int, sigma: float, like: torch.Tensor) -> torch.Tensor:
    offsets = torch.arange(window, dtype=torch.float64) - window // 2
    kernel = torch.exp(-0.5 * (offsets / sigma).square())
    return (kernel / kernel.sum()).to(like)


def _blur(planes: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Blur each plane of [B, C, H, W] alone, first along columns and then along rows, zeros outside.

    A sum of shifted planes: on a CPU this takes a third of the time of a convolution with so few channels.
    """
    weights = kernel.tolist()
    half = len(weights) // 2
    for axis in (2, 3):
        length = planes.shape[axis]
        blurred = planes * weights[half]
        for shift in range(1, min(half, length - 1) + 1):
            kept, weight = length - shift, weights[half - shift]
            blurred.narrow(axis, shift, kept).add_(planes.narrow(axis, 0, kept), alpha=weight)
            blurred.narrow(axis, 0, kept).add_(planes.narrow(axis, shift, kept), alpha=weight)
        planes = blurred
    return planes


def _masked_means(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Weighted mean of each image: values and weights [B, 1, H, W] -> [B]."""
    return (values * weights).sum(dim=(1, 2, 3)) / weights.sum(dim=(1, 2, 3))


def _check_images(pred: torch.Tensor, gt: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor | None:
    check_shape("pred", pred, ("B", "C", "H", "W"))
    batch, _, height, width = pred.shape
    check_shape("gt", gt, pred.shape)
    if mask is None:
        return None
    weights = mask[:, None] if mask.ndim == 3 else mask
    check_shape("mask", weights, (batch, 1, height, width))
    return weights.to(pred.dtype)
