"""A finished run as something a live viewer can show."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bigs.commands.clips.truth import load_truth
from bigs.commands.folder.clip import clip_of_run, hand_models_of_run
from bigs.commands.folder.contents import load_run
from bigs.commands.render.run_pictures import grasp_timeline
from bigs.data.base import Clip
from bigs.geometry.rotations import axis_angle_to_matrix, quat_to_matrix
from bigs.metrics.report import match_frames
from bigs.models.playback import Playback
from bigs.models.repose import FINGERS, bend_fingers, turn_object
from bigs.raster import RasterSettings
from bigs.types import Entity, Gaussians, HandObjectTrajectory
from bigs.viewer.app import Viewer
from bigs.viewer.stage import Mesh, Pose, Splats, Stage, Subject

_NAMES: dict[Entity, str] = {"right": "right hand", "left": "left hand", "object": "object"}
_COLORS: dict[Entity, tuple[int, int, int]] = {
    "right": (225, 87, 89),
    "left": (78, 121, 167),
    "object": (237, 201, 72),
}
_FINGER_RANGE, _TURN_RANGE = (-40, 90), (-180, 180)
_AXES = {"turn about x": 0, "turn about y": 1, "turn about z": 2}


def view(
    run: Path, host: str = "127.0.0.1", port: int = 8080, clip: Path | None = None, gt: Path | None = None
) -> Viewer:
    """Serve a finished run to a browser; the caller closes the viewer.

    Args:
        run: the run folder.
        host: address to listen at.
        port: wanted port; the next free one is taken if it is in use.
        clip: where the input images are; without it where the run found them, if they are still there.
        gt: ground truth to show beside the result.

    Raises:
        InputError: the run, the clip or the truth is invalid, viser is not installed, or the
            address cannot be listened at.
    """
    playback = load_run(run)
    truth = None if gt is None else load_truth(gt, playback.frame_names, hand_models_of_run(run))
    return Viewer(make_stage(playback, clip_of_run(run, len(playback), clip), truth), host, port)


def make_stage(playback: Playback, clip: Clip | None, truth: HandObjectTrajectory | None) -> Stage:
    """What the viewer shows of a run, its clip and its truth, of which the latter two may be missing.

    Raises:
        InputError: the truth lists other frames than the run.
    """
    knobs: dict[str, Mapping[str, tuple[int, int]]] = {}
    for entity in playback.entities:
        names = _AXES if entity == "object" else FINGERS
        limits = _TURN_RANGE if entity == "object" else _FINGER_RANGE
        knobs[_NAMES[entity]] = dict.fromkeys(names, limits)

    def show(frame: int, pose: Pose) -> Mapping[str, Subject]:
        return _subjects(_posed(playback, frame, pose))

    return Stage(
        title=f"bigs: {playback.name}",
        frames=len(playback),
        K=playback.K.numpy(),
        width=playback.width,
        height=playback.height,
        middle=playback.gaussians([len(playback) // 2]).means[0].median(0).values.numpy(),
        colors={_NAMES[entity]: _COLORS[entity] for entity in playback.entities},
        show=show,
        knobs=knobs,
        image=None if clip is None else clip.image,
        truth=None if truth is None else _truth(playback, truth),
        grasps=grasp_timeline(playback),
        fps=playback.fps,
    )


@torch.no_grad()
def _posed(playback: Playback, frame: int, pose: Pose) -> Playback:
    """One frame of the clip, with what the knobs say."""
    moment = playback.at([frame])
    hands, obj = dict(moment.hands), moment.object
    for side in hands:
        degrees = {finger: pose.get((_NAMES[side], finger), 0.0) for finger in FINGERS}
        if any(degrees.values()):
            hands[side] = bend_fingers(hands[side], side, degrees)
    if obj is not None:
        turn = torch.zeros(3)
        for name, axis in _AXES.items():
            turn[axis] = pose.get((_NAMES["object"], name), 0.0)
        if turn.any():
            # About x, then y, then z of the object's own frame.
            x, y, z = axis_angle_to_matrix(torch.diag(torch.deg2rad(turn)))
            obj = turn_object(obj, z @ y @ x)
    return replace(moment, hands=hands, object=obj)


def _subjects(moment: Playback) -> dict[str, Subject]:
    trajectory = moment.trajectory()
    return {
        _NAMES[entity]: Subject(
            drawable(moment.gaussians([0], [entity]), moment.K), mesh_of(trajectory, entity, frame=0)
        )
        for entity in moment.entities
    }


def drawable(gaussians: Gaussians, K: Tensor) -> Splats:
    """Gaussians of one frame, [1, N, ...], as they are seen close by, with covariances R diag(s²) R^T + e² I.

    The engine spreads every Gaussian by a part of a pixel, and they were fitted with that: alone they are too
    small to close a surface, and from nearby its background would show through the cracks. So each keeps, as
    its e, the spread that it had in the clip's picture.
    """
    axes = quat_to_matrix(gaussians.quats[0]) * gaussians.scales[:, None, :]
    colors = gaussians.colors[0] if gaussians.colors.ndim == 3 else gaussians.colors
    means = gaussians.means[0]
    spread = RasterSettings().eps2d * (means[:, 2] / K[0, 0]) ** 2
    covariances = axes @ axes.transpose(-1, -2) + spread[:, None, None] * torch.eye(3)
    return Splats(means.numpy(), covariances.numpy(), colors.numpy(), gaussians.opacities.numpy())


def mesh_of(trajectory: HandObjectTrajectory, entity: Entity, frame: int) -> Mesh:
    """The mesh of an entity that the trajectory has; a bare point set has no faces."""
    if entity != "object":
        return Mesh(trajectory.verts[entity][frame], trajectory.faces[entity])
    assert trajectory.object_verts is not None
    faces = np.zeros((0, 3), np.int64) if trajectory.object_faces is None else trajectory.object_faces
    return Mesh(trajectory.object_verts[frame], faces)


def _truth(playback: Playback, truth: HandObjectTrajectory) -> Callable[[int], Mapping[str, Mesh]]:
    # The index of the ground truth for each frame of the run, matched by name.
    index = match_frames(truth.frame_names, playback.frame_names)
    entities: list[Entity] = [side for side in truth.verts if side in playback.entities]
    if truth.object_verts is not None and playback.object is not None:
        entities.append("object")

    def at(frame: int) -> Mapping[str, Mesh]:
        t = int(index[frame])
        found = {_NAMES[entity]: mesh_of(truth, entity, t) for entity in entities}
        return {name: mesh for name, mesh in found.items() if np.isfinite(mesh.verts).all()}

    return at
