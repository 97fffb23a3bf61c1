"""One picture of a finished reconstruction: from any camera, the clip's own, or one turned about it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from bigs.checks import check_shape
from bigs.models.playback import Playback
from bigs.raster import rasterization
from bigs.types import Entity


@torch.no_grad()
def render_frame(
    playback: Playback,
    frame: int,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    entities: Iterable[Entity] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """One time of the clip from one camera: colour over black [H, W, 3] and alpha [H, W], float in [0, 1].

    `viewmat` [4, 4] leads from the clip's camera frame of that time to the rendering camera (OpenCV axes);
    `entities` are those shown, all if not given.

    Raises:
        InputError: a shape that does not fit, or a frame that the clip has not.
    """
    check_shape("viewmat", viewmat, (4, 4))
    check_shape("K", K, (3, 3))
    out = rasterization(*playback.gaussians([frame], entities), viewmat[None], K[None], width, height)
    return out.colors[0, 0].numpy(), out.alphas[0, 0, ..., 0].numpy()


@torch.no_grad()
def render_depth(
    playback: Playback, frame: int, viewmat: Tensor, K: Tensor, width: int, height: int
) -> np.ndarray:
    """Camera z [H, W], metres, of the Gaussian at which half of a pixel's light is gone; 0 where half passes.

    The arguments are those of `render_frame`, and so are the errors.
    """
    check_shape("viewmat", viewmat, (4, 4))
    check_shape("K", K, (3, 3))
    out = rasterization(
        *playback.gaussians([frame]), viewmat[None], K[None], width, height, median_depth=True
    )
    seen = out.alphas > 0.5
    return torch.where(seen, out.info["render_median"], 0.0)[0, 0, ..., 0].numpy()


def render_input_view(playback: Playback, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """A frame as the clip's own camera saw it; returns as `render_frame`."""
    return render_frame(playback, frame, torch.eye(4), playback.K, playback.width, playback.height)


def straight_rgba(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Colour over black and alpha as 8-bit RGBA whose colour is not multiplied by alpha: [H, W, 4] uint8."""
    straight = color / np.maximum(alpha[..., None], 1e-6)
    rgba = np.concatenate([straight, alpha[..., None]], axis=-1)
    return np.round(255.0 * np.clip(rgba, 0.0, 1.0)).astype(np.uint8)


def orbit_camera(playback: Playback, frame: int, degrees: float) -> Tensor:
    """A camera turned about the scene's middle at a frame, around the image's vertical: viewmat [4, 4]."""
    return turned_camera(playback.gaussians([frame]).means[0].median(0).values, degrees)


def turned_camera(middle: Tensor, degrees: float) -> Tensor:
    """The clip's camera, turned about a point [3] of its space around the image's vertical: [4, 4]."""
    angle = torch.deg2rad(torch.tensor(degrees))
    turn = torch.eye(4)
    turn[0, 0], turn[0, 2] = torch.cos(angle), torch.sin(angle)
    turn[2, 0], turn[2, 2] = -torch.sin(angle), torch.cos(angle)
    turn[:3, 3] = middle - turn[:3, :3] @ middle
    return turn
