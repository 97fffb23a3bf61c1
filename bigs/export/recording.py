"""A clip as a Rerun recording (.rrd): camera, images, Gaussians and meshes over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bigs.atomic import atomic_write
from bigs.checks import InputError
from bigs.types import Gaussians

TIMELINE = "frame"


class Moment(NamedTuple):
    """One frame: metres, OpenCV camera axes."""

    gaussians: Mapping[str, Gaussians]  # subject -> means [N, 3], colours [N, 3]
    meshes: Mapping[str, tuple[np.ndarray, np.ndarray]]  # subject -> vertices [V, 3], faces [F, 3]
    image: np.ndarray | None  # [H, W, 3] uint8


def save_recording(
    path: str | Path, name: str, moments: Iterable[Moment], *, K: np.ndarray, width: int, height: int
) -> None:
    """Write a recording; `path` is whole or absent.

    Entities are `world/camera`, `world/gaussians/SUBJECT` and `world/meshes/SUBJECT`; the timeline counts
    frames.

    Args:
        path: the .rrd file.
        name: of the clip.
        moments: frame by frame; read one at a time.
        K: [3, 3] of the clip's camera, with its `width` and `height` in pixels.

    Raises:
        InputError: rerun is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise InputError(
            f"{path}: expected the extra 'rerun' (pip install 'bigs[rerun]'), found no rerun"
        ) from error
    recording = rerun.RecordingStream("bigs", recording_id=name)
    # The time of writing says nothing about the clip.
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    memory = recording.memory_recording()
    recording.log("world", rerun.ViewCoordinates.RDF, static=True)
    lens = rerun.Pinhole(image_from_camera=K, width=width, height=height)
    recording.log("world/camera", lens, static=True)
    for frame, moment in enumerate(moments):
        recording.set_time(TIMELINE, sequence=frame)
        if moment.image is not None:
            recording.log("world/camera", rerun.Image(moment.image).compress())
        for subject, gaussians in moment.gaussians.items():
            means, quats, scales, opacities, colors = (values.cpu().numpy() for values in gaussians)
            rgba = np.column_stack([np.clip(colors, 0.0, 1.0), np.clip(opacities, 0.0, 1.0)])
            splats = rerun.GaussianSplats3D(
                means,
                scales=scales,
                quaternions=np.roll(quats, -1, axis=1),
                colors=np.round(255.0 * rgba).astype(np.uint8),
            )
            recording.log(f"world/gaussians/{subject}", splats)
        for subject, (verts, faces) in moment.meshes.items():
            mesh = rerun.Mesh3D(vertex_positions=verts, triangle_indices=faces)
            recording.log(f"world/meshes/{subject}", mesh)
    content = memory.drain_as_bytes()
    with atomic_write(path) as file:
        file.write(content)
