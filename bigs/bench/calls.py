"""One render and its gradient, ready to be repeated: what every renderer is timed and judged on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

import numpy as np
import torch

from bigs import _raster
from bigs.bench.peers import PEERS, Render
from bigs.bench.workloads import PARAMETERS, Workload, WorkloadSpec, make_workload
from bigs.raster import RasterSettings, rasterization

Region = Literal["whole", "centre"]
OURS = "bigs"

# Distance between the first and the last of several cameras, metres.
_BASELINE = 0.06


@dataclass(frozen=True)
class Task:
    """What is rendered and differentiated. The defaults are the plain case."""

    workload: WorkloadSpec
    renderer: str = OURS  # or the name of a peer
    dtype: Literal["float32", "float64"] = "float32"
    settings: RasterSettings = field(default_factory=RasterSettings)
    wanted: tuple[str, ...] = PARAMETERS  # gradients
    rendered: Region = "whole"  # "centre": the pixel mask keeps the middle quarter of the image
    differentiated: Region = "whole"  # "centre": no gradient comes from outside the middle quarter
    views: int = 1  # number of cameras, side by side
    apart: bool = False  # whether to render them one by one
    unseen: float = 0.0  # invisible Gaussians to add, as a share of the scene's


class Call:
    """A task with its tensors made."""

    def __init__(self, task: Task) -> None:
        dtype = getattr(torch, task.dtype)
        workload = cached_workload(task.workload)
        gaussians = _with_unseen(workload, task.unseen) if task.unseen else workload.gaussians
        self._render = (
            _bigs_renderer(task, workload) if task.renderer == OURS else PEERS[task.renderer].render
        )
        self.leaves = {
            name: torch.tensor(gaussians[name], dtype=dtype, requires_grad=name in task.wanted)
            for name in PARAMETERS
        }
        # The distance between a pair of eyes.
        self._viewmats = torch.tensor(workload.viewmat, dtype=dtype).repeat(task.views, 1, 1)
        self._viewmats[:, 0, 3] += torch.linspace(0, _BASELINE, task.views, dtype=dtype)
        self._K = torch.tensor(workload.K, dtype=dtype)
        self._size = (workload.width, workload.height)
        self._settings, self._apart = task.settings, task.apart
        self.weights = torch.tensor(workload.weights, dtype=dtype)
        if task.differentiated == "centre":
            self.weights = self.weights * centre_mask(*self._size)[..., None]
        self.info: dict[str, Any] = {}

    def engine_times(self) -> list[tuple[str, float]]:
        """Wall milliseconds of the engine's stages and whole calls on the same arrays, without torch."""
        gaussians = [leaf.detach().numpy() for leaf in self.leaves.values()]
        camera = [self._viewmats[0].numpy(), self._K.numpy()]
        seconds = _raster.time_engine(gaussians, camera, *self._size, self._settings, self.weights.numpy())
        return [(name, 1e3 * value) for name, value in seconds]

    def forward(self) -> torch.Tensor:
        """The image [H, W, 3], of several views [views, H, W, 3]; `info` becomes what was told about it."""
        if not self._apart:
            viewmats = self._viewmats[0] if len(self._viewmats) == 1 else self._viewmats
            image, self.info = self._render(self.leaves, viewmats, self._K, *self._size)
            return image
        images = []
        for viewmat in self._viewmats:
            image, self.info = self._render(self.leaves, viewmat, self._K, *self._size)
            images.append(image)
        return torch.stack(images)

    def backward(self, image: torch.Tensor) -> dict[str, np.ndarray]:
        """Gradients of sum(image · weights) for the wanted arrays."""
        wanted = {name: leaf for name, leaf in self.leaves.items() if leaf.requires_grad}
        found = torch.autograd.grad(image, list(wanted.values()), self.weights.expand_as(image))
        return {name: gradient.numpy() for name, gradient in zip(wanted, found, strict=True)}


@cache
def cached_workload(spec: WorkloadSpec) -> Workload:
    """The workload, made once in a process."""
    return make_workload(spec)


def centre_mask(width: int, height: int) -> torch.Tensor:
    """True in the middle quarter of an image; bool [H, W]."""
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[height // 4 : math.ceil(3 * height / 4), width // 4 : math.ceil(3 * width / 4)] = True
    return mask


def _with_unseen(workload: Workload, part: float) -> dict[str, np.ndarray]:
    """The Gaussians and more that no pixel sees: behind the camera, beside the image, and too faint."""
    count = round(part * len(workload.gaussians["means"]))
    added = {name: array[:count].copy() for name, array in workload.gaussians.items()}
    rotation, shift = workload.viewmat[:3, :3], workload.viewmat[:3, 3]
    points = added["means"] @ rotation.T + shift
    points[0::3, 2] *= -1
    points[1::3, 0] = 30 * np.abs(points[1::3, 2])
    added["means"] = ((points - shift) @ np.linalg.inv(rotation).T).astype(np.float32)
    added["opacities"][2::3] = 1e-3
    return {name: np.concatenate([array, added[name]]) for name, array in workload.gaussians.items()}


def _bigs_renderer(task: Task, workload: Workload) -> Render:
    mask = centre_mask(workload.width, workload.height)[None] if task.rendered == "centre" else None

    # Of one view, or [views, 4, 4].
    def render(
        leaves: dict[str, torch.Tensor], viewmat: torch.Tensor, K: torch.Tensor, width: int, height: int
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        viewmats = viewmat.reshape(-1, 4, 4)
        output = rasterization(
            leaves["means"],
            leaves["quats"],
            leaves["scales"],
            leaves["opacities"],
            leaves["colors"],
            viewmats,
            K.expand(len(viewmats), 3, 3),
            width,
            height,
            settings=task.settings,
            pixel_mask=mask,
        )
        return (output.colors if viewmat.ndim == 3 else output.colors[0]), output.info

    return render
