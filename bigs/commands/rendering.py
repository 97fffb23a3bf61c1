"""Rendering a finished reconstruction: from given cameras, and from the clip's own."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from bigs.commands.run_folder import load_run
from bigs.data.transforms import load_transforms
from bigs.models.playback import Playback
from bigs.raster import rasterization
from bigs.types import Entity
from bigs.viewer.preview import save_picture


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
    """
    out = rasterization(*playback.gaussians([frame], entities), viewmat[None], K[None], width, height)
    return out.colors[0, 0].numpy(), out.alphas[0, 0, ..., 0].numpy()


def render_input_view(playback: Playback, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """A frame as the clip's own camera saw it; returns as `render_frame`."""
    return render_frame(playback, frame, torch.eye(4), playback.K, playback.width, playback.height)


def straight_rgba(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Colour over black and alpha as 8-bit RGBA whose colour is not multiplied by alpha: [H, W, 4] uint8."""
    straight = color / np.maximum(alpha[..., None], 1e-6)
    rgba = np.concatenate([straight, alpha[..., None]], axis=-1)
    return np.round(255.0 * np.clip(rgba, 0.0, 1.0)).astype(np.uint8)


def render_cameras(run: Path, cameras: Path, out: Path) -> list[Path]:
    """Render a run from the cameras of a `transforms.json` into `out/%04d.png`, in the file's order.

    Raises:
        InputError: the run or the cameras are not as they should be.
    """
    playback = load_run(run)
    views = load_transforms(cameras, frame_count=len(playback))
    out.mkdir(parents=True, exist_ok=True)
    files = []
    for index, view in enumerate(views):
        color, alpha = render_frame(
            playback,
            view.frame_index,
            torch.as_tensor(view.viewmat, dtype=torch.float32),
            torch.as_tensor(view.K, dtype=torch.float32),
            view.width,
            view.height,
        )
        path = out / f"{index:04d}.png"
        save_picture(path, Image.fromarray(straight_rgba(color, alpha), "RGBA"))
        files.append(path)
    return files


def orbit_camera(playback: Playback, frame: int, degrees: float) -> Tensor:
    """A camera turned about the scene's middle at a frame, around the image's vertical: viewmat [4, 4]."""
    middle = playback.gaussians([frame]).means[0].median(0).values
    angle = torch.deg2rad(torch.tensor(degrees))
    turn = torch.eye(4)
    turn[0, 0], turn[0, 2] = torch.cos(angle), torch.sin(angle)
    turn[2, 0], turn[2, 2] = -torch.sin(angle), torch.cos(angle)
    turn[:3, 3] = middle - turn[:3, :3] @ middle
    return turn
