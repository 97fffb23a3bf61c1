"""Completion by symmetry of a scene whose poses are final: they stay, and so does what shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.spatial
import torch
from torch import Tensor

from bigs.data.base import Clip
from bigs.geometry.arrays import float32
from bigs.geometry.mesh import face_areas, frames_from_normals, point_spacing, sample_surface
from bigs.geometry.rotations import matrix_to_quat
from bigs.geometry.support import seen_samples
from bigs.geometry.symmetry import SeenSurface, Symmetry, completed
from bigs.models.canonical import CanonicalObject
from bigs.models.object_detail import ObjectDetail, replace_gaussians, split_object
from bigs.models.object_splats import ObjectSplatsConfig
from bigs.models.scene import ObjectSurface, Scene
from bigs.train.loop.step import Evidence
from bigs.train.plan.config import CompletionStage
from bigs.train.plan.start_config import CompletionConfig, InitialConfig
from bigs.train.start.completion import Completion, complete
from bigs.train.start.initial import ObjectStart, object_in_camera
from bigs.train.start.visual_hull import find_object_hull, usable_views
from bigs.train.unseen.visibility import (
    SHOWS,
    frames_seen,
    guard_frames,
    image_error,
    object_views,
    weights_in_pictures,
)

# Gaussians that show are kept, and none that would show is added. Removing one may reveal the next, so they
# are checked again.
_PASSES = 3
# Colours of what was never seen average over this many mirrored Gaussians, since a pattern need not continue.
_COLORS_FROM = 8
# The colour of a place averages over this many Gaussians: after many steps neighbours differ by more than the
# surface does, since only their sum shows.
_BLENDED = 24


class StageOutcome(NamedTuple):
    """Facts to report."""

    skipped: str | None  # why nothing was changed
    facts: dict[str, str]


def complete_scene(
    scene: Scene,
    clip: Clip,
    unknown: np.ndarray,
    evidence: Evidence,
    stage: CompletionStage,
    initial: InitialConfig,
    completion: CompletionConfig,
    obj: ObjectSplatsConfig,
    earlier: Sequence[Symmetry] = (),
) -> StageOutcome:
    """Complete the object by its symmetries where the clip never showed it; in place.

    The mesh is made again. Gaussians that show in any frame are kept, the others are replaced. If the clip's
    own frames then show worse than the stage allows, all is undone.

    Args:
        scene: has an object; its poses are final.
        clip, unknown: as the scene was built from.
        evidence: the clip at the size at which the guard looks.
        stage, initial, completion, obj: see those classes.
        earlier: see `complete`.
    """
    scene.requires_grad_(False)
    start = _at_final_poses(scene, clip, initial)
    seen = _share_seen(scene, clip, start, initial)
    # Where that much was seen, the surface made anew would say the same.
    if seen >= completion.enough:
        return StageOutcome(f"{seen:.0%} of the object's surface was seen", _seen_fact(seen))
    canonical = scene.object_splats()
    start = start._replace(colors=_colors_found(canonical, scene, evidence, start.points))
    try:
        hull = find_object_hull(clip, unknown, start, initial)
        found = complete(hull, start, initial, completion, earlier)
    except (ValueError, scipy.spatial.QhullError) as reason:
        return StageOutcome(f"masks and points give no surface: {reason}", {})
    facts = _seen_fact(found.seen)
    if not found.symmetries:
        return StageOutcome(str(found), facts)
    frames = guard_frames(scene.n_frames)
    before = image_error(scene, evidence, scene.entities, frames)
    splats, surface = scene.object_splats, scene.object_surface
    detail = splats if isinstance(splats, ObjectDetail) else split_object(canonical, 1, 0.0)
    left = weights_in_pictures(scene, evidence) >= SHOWS
    verts, faces = found.surface.mesh()
    added = _far_side(canonical, left.numpy(), found, verts, faces, obj)
    for _ in range(_PASSES):
        scene.object_splats = replace_gaussians(detail, left, added)
        hidden = weights_in_pictures(scene, evidence)[int(left.sum()) :] < SHOWS
        added = CanonicalObject(*(values[hidden] for values in added))
        if hidden.all():
            break
    scene.object_splats = replace_gaussians(detail, left, added)
    as_tensor = torch.as_tensor(verts, dtype=torch.float32)
    scene.replace_surface(ObjectSurface(as_tensor, torch.as_tensor(faces.copy())))
    change = image_error(scene, evidence, scene.entities, frames) / max(before, 1e-12) - 1.0
    if change > stage.most_worsening:
        scene.object_splats = splats
        scene.replace_surface(surface)
        reason = f"undone, since the clip's frames would look worse ({change:+.1%} error)"
        return StageOutcome(reason, facts)
    facts["object completed"] = f"{found}; error of the clip's frames {change:+.1%}"
    return StageOutcome(None, facts)


def _at_final_poses(scene: Scene, clip: Clip, initial: InitialConfig) -> ObjectStart:
    """The clip's points in the poses that were found."""
    start = object_in_camera(clip, initial)
    pose = scene.at(torch.arange(scene.n_frames)).object
    return start._replace(rotations=pose.rotations, centers=pose.centers / pose.scale)


def _share_seen(scene: Scene, clip: Clip, start: ObjectStart, initial: InitialConfig) -> float:
    """How much of the surface that the scene has by now was seen, in the frames and poses of `start`."""
    views = usable_views(clip, start)
    if views is None:
        return 0.0
    surface = scene.object_surface.verts.numpy(), scene.object_surface.faces.numpy()
    return float(seen_samples(views, *surface, initial.seen_frames, initial.seen_tolerance).seen.mean())


def _seen_fact(share: float) -> dict[str, str]:
    return {"object seen": f"{share:.0%} of its surface"}


def _colors_found(
    canonical: CanonicalObject, scene: Scene, evidence: Evidence, points: np.ndarray
) -> np.ndarray:
    """The colours [M, 3] that the clip showed at points [M, 3] of the object."""
    shown = frames_seen(canonical, object_views(scene, evidence)) > 0
    if not shown.any():
        shown[:] = True
    return blended_colors(canonical, shown, points)


def blended_colors(canonical: CanonicalObject, chosen: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The colours [M, 3] that those `chosen` [N] (bool) of N Gaussians together have at points [M, 3]."""
    index = np.flatnonzero(chosen)
    nearest = range(1, min(_BLENDED, len(index)) + 1)
    near = index[scipy.spatial.cKDTree(canonical.means.numpy()[index]).query(points, k=nearest)[1]]
    # The area that a Gaussian covers if it lies flat.
    area = canonical.opacities * canonical.scales.sort(dim=-1).values[:, 1:].prod(-1)
    weights = area.numpy()[near, None]
    return (weights * canonical.colors.numpy()[near]).sum(1) / weights.sum(1)


def _far_side(
    canonical: CanonicalObject,
    left: np.ndarray,
    found: Completion,
    verts: np.ndarray,
    faces: np.ndarray,
    obj: ObjectSplatsConfig,
) -> CanonicalObject:
    """Gaussians on the completed surface where those `left` [N] do not cover it, coloured as they are."""
    means = canonical.means.numpy().astype(np.float64)
    spacing = float(np.median(point_spacing(means)))
    points, normals = sample_surface(verts, faces, int(face_areas(verts, faces).sum() / spacing**2))
    free = scipy.spatial.cKDTree(means[left]).query(points)[0] > spacing
    points, normals = points[free], normals[free]
    there = SeenSurface(means[left], canonical.normals.numpy()[left], canonical.colors.numpy()[left])
    anywhere = lambda x: np.zeros(len(x), dtype=bool)  # noqa: E731  all lie on the surface
    whole = completed(there, found.symmetries, anywhere, 2.0 * spacing)
    count = min(_COLORS_FROM, len(whole.points))
    nearest = scipy.spatial.cKDTree(whole.points).query(points, k=[*range(1, count + 1)])[1]
    sigma = obj.scale_per_spacing * spacing
    centers = float32(points - obj.flatness * sigma * normals)
    scales: Tensor = float32(sigma * np.array([1.0, 1.0, obj.flatness]))
    return CanonicalObject(
        centers,
        torch.zeros_like(centers),
        matrix_to_quat(float32(frames_from_normals(normals))),
        scales.expand(len(centers), 3),
        torch.full((len(centers),), obj.opacity),
        float32(whole.colors[nearest].mean(1)),
        float32(normals),
        canonical.weights[torch.as_tensor(scipy.spatial.cKDTree(means).query(points)[1])],
    )
