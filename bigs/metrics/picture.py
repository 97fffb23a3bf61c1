"""Similarity of rendered and true pictures, and which pixels count.

Published figures rarely say what they mask. Here there are two ways, both over black: `full` compares the
render as it is with the true image blanked outside its mask, every pixel counting, so that what spills over
the mask is an error; `foreground` blanks both, so that only what lies inside the mask is compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from bigs.checks import check_shape
from bigs.metrics.image import psnr, ssim_map
from bigs.metrics.report import METRICS, Metric

# A distance of two batches of images [1, 3, H, W] in [0, 1], such as LPIPS.
Distance = Callable[[Tensor, Tensor], Tensor]

PICTURE_METRICS: dict[str, Metric] = {
    "psnr_foreground": Metric("PSNR of the foreground", "dB", "higher"),
    "psnr_full": Metric("PSNR, whole frame", "dB", "higher", detail=True),
    "ssim_foreground": Metric("SSIM of the foreground", "", "higher"),
    "ssim_inside": Metric("SSIM inside the mask", "", "higher", detail=True),
    "ssim_full": Metric("SSIM, whole frame", "", "higher", detail=True),
    "lpips_foreground": Metric("LPIPS of the foreground", "", "lower"),
    "lpips_full": Metric("LPIPS, whole frame", "", "lower", detail=True),
}
# The same for held-out views: as they are, and after the one scale per clip that a single camera cannot see.
NOVEL, NOVEL_SCALED = "novel_", "novel_scaled_"
PICTURE_METRICS |= {
    f"{prefix}{key}": Metric(f"{metric.paper}, {views}", metric.unit, metric.better, metric.detail)
    for prefix, views in ((NOVEL, "novel views"), (NOVEL_SCALED, "novel views, one scale for the clip"))
    for key, metric in PICTURE_METRICS.items()
}
# Half a centimetre of depth moves texture by a few pixels in a turned view and hides every other fault.
ALIGNED = "psnr_aligned"
PICTURE_METRICS |= {
    f"{prefix}{ALIGNED}": Metric(f"PSNR of each subject where it fits best, {views}", "dB", "higher")
    for prefix, views in ((NOVEL, "novel views"), (NOVEL_SCALED, "novel views, one scale for the clip"))
}
ALL_METRICS = METRICS | PICTURE_METRICS


def picture_scores(
    render: np.ndarray, image: np.ndarray, mask: np.ndarray, distance: Distance | None = None
) -> dict[str, float]:
    """The scores of one picture; `PICTURE_METRICS` says what each key means.

    PSNR takes one mean squared error over the pixels and channels that count: all, or those of the mask.
    SSIM of the foreground is a mean over the whole blanked frames, most of which agree; `ssim_inside` is the
    mean over the mask alone.

    Args:
        render: colours over black, [H, W, 3] in [0, 1].
        image: the truth, [H, W, 3] in [0, 1].
        mask: bool [H, W], what of the truth is reconstructed.
        distance: a perceptual distance; without it there are no keys for it.

    Returns:
        Scores by key; NaN for an empty mask.

    Raises:
        InputError: another shape.
    """
    check_shape("render", render, ("H", "W", 3))
    check_shape("image", image, render.shape)
    check_shape("mask", mask, render.shape[:2])
    weights = torch.as_tensor(mask)[None]
    pred, gt = (
        torch.as_tensor(picture, dtype=torch.float32).permute(2, 0, 1)[None] for picture in (render, image)
    )
    pred, inside = pred.clamp(0.0, 1.0), weights[:, None].to(torch.float32)
    if not bool(weights.any()):
        return {key: float("nan") for key in _keys(distance is not None)}
    cut, true = pred * inside, gt * inside
    similarity = _similarity(cut, true)
    scores = {
        "psnr_foreground": psnr(pred, gt, weights),
        "psnr_full": psnr(pred, true),
        "ssim_foreground": similarity.mean(),
        "ssim_inside": similarity[weights].mean(),
        "ssim_full": _similarity(pred, true).mean(),
    }
    if distance is not None:
        scores |= {"lpips_foreground": distance(cut, true), "lpips_full": distance(pred, true)}
    return {key: float(value) for key, value in scores.items()}


# Half the side of the window of SSIM, pixels.
_WINDOW = 5


def _similarity(pred: Tensor, true: Tensor) -> Tensor:
    """The mean over channels of the SSIM map of two pictures [1, 3, H, W]: [1, H, W].

    Where both are black as far as the window reaches it is 1, so only the rest is looked at.
    """
    shown = ((pred != 0) | (true != 0)).any(dim=1)[0]
    similarity = torch.ones_like(pred[:, 0])
    if shown.any():
        (top, bottom), (left, right) = (
            (max(int(lines[0]) - _WINDOW, 0), int(lines[-1]) + 1 + _WINDOW)
            for lines in (shown.any(dim=axis).nonzero()[:, 0] for axis in (1, 0))
        )
        box = (..., slice(top, bottom), slice(left, right))
        similarity[box] = ssim_map(pred[box], true[box], 2 * _WINDOW + 1).mean(dim=1)
    return similarity


def aligned_psnr(
    renders: Mapping[str, np.ndarray], image: np.ndarray, masks: Mapping[str, np.ndarray], reach: int = 8
) -> float:
    """PSNR in dB of each subject alone, after its best shift.

    Each subject's squared error is a mean over the pixels and channels of its mask. A shift is a whole number
    of pixels along each axis, no longer than `reach`; what it brings in from beyond the image is black.

    Args:
        renders: colours over black of each subject alone, [H, W, 3] in [0, 1], by name.
        image: the truth, [H, W, 3] in [0, 1].
        masks: bool [H, W], where the truth shows each subject.
        reach: the longest shift, pixels.

    Returns:
        The mean over the subjects, weighted by the areas of their masks; NaN when all masks are empty.
    """
    offsets = np.arange(-reach, reach + 1)
    shifts = [(dy, dx) for dy in offsets for dx in offsets if dy * dy + dx * dx <= reach * reach]
    total, area = 0.0, 0
    for name, mask in masks.items():
        rows, columns = np.nonzero(mask)
        if len(rows) == 0:
            continue
        padded = np.pad(renders[name], ((reach, reach), (reach, reach), (0, 0)))
        true = image[rows, columns]
        least = min(
            np.square(padded[rows + reach + dy, columns + reach + dx] - true).mean() for dy, dx in shifts
        )
        total += len(rows) * (np.inf if least == 0.0 else -10.0 * np.log10(least))
        area += len(rows)
    return total / area if area else float("nan")


def _keys(with_distance: bool) -> list[str]:
    return [
        key
        for key in PICTURE_METRICS
        if not key.startswith(NOVEL) and (with_distance or not key.startswith("lpips"))
    ]
