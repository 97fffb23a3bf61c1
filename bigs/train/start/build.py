"""A scene at its start values: canonical hands, the object's surface and its Gaussians, smoothed poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.spatial
import torch
from torch import Tensor

from bigs.data.base import Clip
from bigs.geometry.coverage import MeasuredPoints
from bigs.geometry.distance import DistanceField
from bigs.geometry.mesh import face_areas, sample_surface
from bigs.geometry.support import Support, seen_samples
from bigs.geometry.surface import DistanceGrid, extract_mesh
from bigs.geometry.symmetry import Symmetry
from bigs.hand import HandModel, shared_betas
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.models.lighting import Lighting
from bigs.models.object_splats import ObjectSplats, ObjectSplatsConfig
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import ObjectSurface, Scene
from bigs.motion.tracker import TrackedMotion
from bigs.train.plan.start_config import CompletionConfig, InitialConfig
from bigs.train.start.completion import complete
from bigs.train.start.hand_color import hand_color
from bigs.train.start.initial import ObjectStart, hand_in_camera, object_in_camera, smooth_hand, smooth_object
from bigs.train.start.object_motion import pose_errors, with_motion
from bigs.train.start.visual_hull import convex_surface, find_object_hull
from bigs.types import Entity, Side


class KnownPart(NamedTuple):
    """The part of the object's closed surface with evidence for it."""

    verts: Tensor  # [V] indices of its vertices
    faces: Tensor  # [F, 3] among these
    left_out: float  # share of the closed surface's area

    def of(self, closed: ObjectSurface) -> ObjectSurface:
        """That part of the closed surface, whose vertices may have moved."""
        return ObjectSurface(closed.verts[self.verts], self.faces)


class SceneStart(NamedTuple):
    """A scene at its start values, and facts about them."""

    scene: Scene
    skipped: list[str]  # what was not done, or replaced by something simpler, and why
    symmetries: list[Symmetry]  # of the object, where they were looked for
    known: KnownPart | None  # of the object's surface, if that is not all
    measured: MeasuredPoints  # of the object; none without an object


def build_scene(
    clip: Clip,
    unknown: np.ndarray,
    hand_models: Mapping[Side, HandModel],
    initial: InitialConfig,
    hand: HandSplatsConfig,
    obj: ObjectSplatsConfig,
    lighting: bool,
    completion: CompletionConfig | None = None,
    motion: TrackedMotion | None = None,
) -> SceneStart:
    """A scene at its start values.

    Args:
        clip: the loaded clip.
        unknown: [T, H, W] bool, unlabelled occluders (see `background`).
        hand_models: both sides' models in their files' own conventions.
        initial, hand, obj: see those classes.
        lighting: whether colours depend on the direction a surface faces.
        completion: where much of the object was never seen, its symmetries are looked for, and hands meet
            what they make of it; if it has none, hands meet nothing there. Otherwise, and without it, they
            meet the closed surface.
        motion: of the object, if tracks were used; it replaces the smoothed estimates.
    """
    starts = {
        side: smooth_hand(
            hand_in_camera(track, clip.cam_from_world, hand_models[side], initial), initial.smooth_hands
        )
        for side, track in clip.hands.items()
    }
    canonical = _canonical_hands(clip, hand_models, hand)
    seen = hand_color(clip) if canonical else None
    skipped: list[str] = []
    symmetries: list[Symmetry] = []
    known = None
    nothing = np.empty((0, 2), dtype=int)
    measured = MeasuredPoints(np.empty((0, 3)), nothing)
    object_parts = dict.fromkeys(("object_splats", "object_poses", "object_surface", "object_distance"), None)
    if clip.object is not None:
        start = object_in_camera(clip, initial)
        errors = None if motion is None else pose_errors(motion)
        if motion is None:
            start = smooth_object(start, initial.smooth_object)
        else:
            start = with_motion(start, motion)
        if motion is None:
            measured = MeasuredPoints(start.points, nothing)
        else:
            measured = MeasuredPoints(motion.points, motion.sightings)
        surfaces = _object_surfaces(clip, unknown, start, initial, completion)
        skipped, symmetries, known = surfaces.skipped, surfaces.symmetries, surfaces.known
        verts, faces = surfaces.closed
        points, normals = sample_surface(verts, faces, obj.n_gaussians)
        object_parts = {
            "object_splats": ObjectSplats(points, normals, _nearest_colors(points, start), obj),
            "object_poses": ObjectPoses(start.rotations, start.centers, errors),
            "object_surface": _as_surface(verts, faces),
            "object_distance": DistanceField(surfaces.solid),
        }
    n_frames = len(clip)
    present: list[Entity] = [*clip.hands]
    if clip.object is not None:
        present.append("object")
    scene = Scene(
        K=torch.as_tensor(clip.K, dtype=torch.float32),
        width=clip.width,
        height=clip.height,
        hand_splats={side: HandSplats(model, hand, seen) for side, (model, _) in canonical.items()},
        betas={side: betas for side, (_, betas) in canonical.items()},
        hand_poses={
            side: HandPoses(start.global_orient, start.hand_pose, start.wrist)
            for side, start in starts.items()
        },
        lighting=Lighting(present, n_frames) if lighting else None,
        **object_parts,
    )
    return SceneStart(scene, skipped, symmetries, known, measured)


# A mesh that would lose less of its area stays closed.
_LITTLE = 0.005


def _as_surface(verts: np.ndarray, faces: np.ndarray) -> ObjectSurface:
    return ObjectSurface(torch.as_tensor(verts, dtype=torch.float32), torch.as_tensor(faces.copy()))


class _ObjectSurfaces(NamedTuple):
    """The object's surface, for each use."""

    closed: tuple[np.ndarray, np.ndarray]  # vertices and faces
    known: KnownPart | None
    solid: DistanceGrid  # what hands touch
    symmetries: list[Symmetry]
    skipped: list[str]


def _object_surfaces(
    clip: Clip,
    unknown: np.ndarray,
    start: ObjectStart,
    initial: InitialConfig,
    completion: CompletionConfig | None,
) -> _ObjectSurfaces:
    try:
        hull = find_object_hull(clip, unknown, start, initial)
        surface = hull.closed(initial, hull.points, hull.normals)
        grid, closed = surface.grid, surface.mesh()
    except (ValueError, scipy.spatial.QhullError) as reason:
        grid = convex_surface(start, initial)
        closed = extract_mesh(grid, start.points)
        why = f"object surface from masks: {reason}; using the points' convex hull instead"
        return _ObjectSurfaces(closed, None, grid, [], [why])
    support = Support(
        seen_samples(hull.views, *closed, initial.seen_frames, initial.seen_tolerance), hull.points
    )
    verts, faces = support.known_part(*closed, initial.surface_kept)
    left_out = 1.0 - face_areas(closed[0][verts], faces).sum() / face_areas(*closed).sum()
    known = None
    if left_out > _LITTLE:
        known = KnownPart(torch.as_tensor(verts), torch.as_tensor(faces), left_out)
    symmetries: list[Symmetry] = []
    if completion is not None and support.guessed(initial.surface_solid) > initial.surface_guessed:
        done = complete(hull, start, initial, completion)
        symmetries = done.symmetries
        if symmetries:
            # A hull of few directions is deep: its far side is no surface that a hand could hold.
            grid = done.surface.grid
        else:
            grid = support.without_guesses(grid, initial.surface_solid)
    return _ObjectSurfaces(closed, known, grid, symmetries, [])


def _canonical_hands(
    clip: Clip, models: Mapping[Side, HandModel], config: HandSplatsConfig
) -> dict[Side, tuple[HandModel, Tensor]]:
    """The right-handed model and start shape of each canonical hand."""
    right = models["right"]
    shapes: dict[Side, Tensor] = {}
    for side, track in clip.hands.items():
        betas = torch.as_tensor(track.betas, dtype=torch.float32)
        shapes[side] = betas if side == "right" else shared_betas(right, models["left"], betas)
    if not shapes:
        return {}
    if config.shared:
        return {"right": (right, likely_shape(list(shapes.values()), config.shape_error, config.size_error))}
    return {
        side: (right, likely_shape([betas], config.shape_error, config.size_error))
        for side, betas in shapes.items()
    }


def likely_shape(estimates: Sequence[Tensor], error: float, size_error: float) -> Tensor:
    """The most likely betas [10] of one person given estimates of both hands, or of one.

    The paper takes the right hand's; two independent estimates are better averaged, and as betas have unit
    variance among people, an uncertain estimate lies too far out. How uncertain the mean is, both hands'
    difference tells; of size it does not, as one difference is too few.

    Args:
        estimates: one or two shapes [10].
        error: standard deviation of one estimate where there is no second; 0 takes estimates as they are.
        size_error: the same of the first of betas, overall size, for each estimate; 0 takes `error`.
    """
    mean = torch.stack(list(estimates)).mean(0)
    if error == 0.0:
        return mean
    variance = error**2
    if len(estimates) == 2:
        variance = float((estimates[0] - estimates[1]).square().mean()) / 4.0
    variances = torch.full_like(mean, variance)
    if size_error > 0.0:
        variances[0] = size_error**2 / len(estimates)
    return mean / (1.0 + variances)


def _nearest_colors(points: np.ndarray, start: ObjectStart) -> np.ndarray:
    if start.colors is None:
        return np.full((len(points), 3), 0.5)
    _, index = scipy.spatial.cKDTree(start.points).query(points, k=min(3, len(start.points)))
    return start.colors[index].reshape(len(points), -1, 3).mean(1)
