"""Openings: a closed surface has a lid where the object has none, and what is behind it is seen there.

It also fills the grip of a hand that never lets go, where the hand itself is.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.spatial
import torch
from torch import Tensor

from bigs.fused.shape import times_empty
from bigs.geometry.coverage import MeasuredPoints, ObjectViews, seen_in
from bigs.geometry.mesh import face_areas, midpoint_subdivision, sample_surface, vertex_normals
from bigs.models.scene import ObjectSurface, Scene
from bigs.train.loop.step import Evidence
from bigs.train.plan.config import OpeningConfig
from bigs.train.unseen.visibility import TOLERANCE, object_views
from bigs.types import Side

# At least so many samples of a hand's surface that may show, about so many of the object's that may hide it.
_HAND_SAMPLES, _OCCLUDERS = 8000, 20_000
# A hand's outline may be wrong by so many pixels.
_MARGIN = 2
# Brightness is compared as a ratio; this much of full brightness is noise.
_DARK = 0.02
# How a vertex' brightness varies is the median of so many vertices around it.
_AROUND = 32
# Up to this share of what was measured, brightness varies as it does on surface that is there. A plain object
# has few measured points, and its sides vary more than half of them.
_USUAL = 0.95
# Frames that must show a vertex before its brightness says anything.
_LEAST_SHOWN = 5


def openings(
    scene: Scene,
    surface: ObjectSurface,
    evidence: Evidence,
    measured: MeasuredPoints,
    config: OpeningConfig,
) -> np.ndarray:
    """Which vertices [V] (bool) of the object's surface lie in openings.

    Where a hand that the masks show or a point that a frame measured lies behind surface, that surface cannot
    be there. The opening goes on from there as far as nothing was measured and brightness varies over time as
    it does where a picture was painted on the wrong place. Nor can surface be where a hand is that holds it.

    Args:
        scene: has an object; its poses are final.
        surface: of the object.
        evidence: the clip at the size at which to look.
        measured: points of the object.
        config: see there.
    """
    verts, faces = surface.verts.double().numpy(), surface.faces.numpy()
    views = object_views(scene, evidence)
    area = _vertex_areas(verts, faces)
    unmeasured = scipy.spatial.cKDTree(measured.points).query(verts)[0] > config.measured
    hands = {side: _on_object(scene, side) for side in scene.sides}
    gripped = unmeasured & _in_grips(scene, hands, verts, config)
    gripped &= _with_proof(faces, gripped, area * gripped, config.area)
    least, least_points = (
        max(config.frames, share * scene.n_frames) for share in (config.share, config.points_share)
    )
    proven = _hands_behind(hands, evidence, views, verts, config.depth) >= least
    proven |= _points_behind(views, verts, measured, config.depth) >= least_points
    proven &= unmeasured
    if area[proven].sum() < config.area:
        return gripped
    varies = _variation(scene, evidence, views, verts, faces)
    there = varies[~unmeasured]
    most = np.nanquantile(there, _USUAL) if np.isfinite(there).any() else np.inf
    # Comparisons with what is not known are false.
    open_ = proven | (unmeasured & (varies > most))
    return gripped | _with_proof(faces, open_, area * proven, config.area)


def without_openings(surface: ObjectSurface, open_: np.ndarray) -> ObjectSurface:
    """A surface without the vertices [V] (bool) that lie in openings, and without their faces."""
    faces = surface.faces.numpy()
    used, kept = np.unique(faces[~open_[faces].any(axis=1)], return_inverse=True)
    return ObjectSurface(surface.verts[torch.as_tensor(used)], torch.as_tensor(kept.reshape(-1, 3)))


class _Hand(NamedTuple):
    """A hand as the object sees it."""

    verts: Tensor  # [T, V, 3] in the object's frame
    faces: np.ndarray  # [F, 3]
    follow: scipy.sparse.csr_matrix  # [N, V] samples of its surface


def _on_object(scene: Scene, side: Side) -> _Hand:
    posed, model = scene.at(torch.arange(scene.n_frames)), scene.hand_model(side)
    with torch.no_grad():
        verts = posed.in_object_frame(posed.verts(side))
    faces = model.faces_of(side).numpy()
    # The same places in every frame: spreading samples anew takes seconds.
    return _Hand(verts, faces, _places(faces, len(model.v_template)))


def _hands_behind(
    hands: Mapping[Side, _Hand], evidence: Evidence, views: ObjectViews, verts: np.ndarray, depth: float
) -> np.ndarray:
    """In how many frames [V] a hand shows more than `depth` behind vertices [V, 3]; each hand counts."""
    count = np.zeros(len(verts), dtype=np.int64)
    for side, hand in hands.items():
        shown = evidence.targets.shares[side].numpy() > 0.5
        inside = scipy.ndimage.binary_erosion(shown, np.ones((1, 3, 3)), iterations=_MARGIN)
        for t in np.flatnonzero(inside.any(axis=(1, 2))):
            one = slice(t, t + 1)
            frame = ObjectViews(inside[one], views.K, views.rotations[one], views.centers[one])
            places = hand.follow @ hand.verts[t].double().numpy()
            count += times_empty(frame.shown, frame.poses, verts, places, depth)
    return count


def _points_behind(
    views: ObjectViews, verts: np.ndarray, measured: MeasuredPoints, depth: float
) -> np.ndarray:
    """In how many frames [V] a point that they measured lies more than `depth` behind vertices [V, 3]."""
    count = np.zeros(len(verts), dtype=np.int64)
    everywhere = np.ones_like(views.shown[:1])
    frame, index = measured.sightings.T
    for t in np.unique(frame):
        one = slice(t, t + 1)
        here = ObjectViews(everywhere, views.K, views.rotations[one], views.centers[one])
        count += times_empty(here.shown, here.poses, verts, measured.points[index[frame == t]], depth)
    return count


def _in_grips(
    scene: Scene, hands: Mapping[Side, _Hand], verts: np.ndarray, config: OpeningConfig
) -> np.ndarray:
    """Which vertices [V] (bool) lie inside a hand that holds the object for as many frames as count."""
    inside = np.zeros(len(verts), dtype=bool)
    for side, hand in hands.items():
        grasps = scene.grasps[side]
        for grasp in range(grasps.count):
            held = grasps.of_frame == grasp
            if held.sum() < config.frames:
                continue
            usual = hand.verts[held].median(0).values.double().numpy()
            places = hand.follow @ usual
            normals = hand.follow @ vertex_normals(usual, hand.faces)
            nearest = scipy.spatial.cKDTree(places).query(verts)[1]
            inside |= ((places[nearest] - verts) * normals[nearest]).sum(-1) > config.inside
    return inside


def _places(faces: np.ndarray, count: int) -> scipy.sparse.csr_matrix:
    """Vertices and midpoints of a mesh of `count` vertices, halved until they are many enough: [N, count]."""
    follow = scipy.sparse.identity(count, format="csr")
    while follow.shape[0] < _HAND_SAMPLES:
        step, faces = midpoint_subdivision(faces, follow.shape[0])
        follow = step @ follow
    return follow


def _variation(
    scene: Scene, evidence: Evidence, views: ObjectViews, verts: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """How much brightness around vertices varies from frame to frame, logarithm [V]; NaN where unknown.

    What a frame's light does to all vertices by their normals is left out.
    """
    normals = vertex_normals(verts, faces)
    occluders, _ = sample_surface(verts, faces, _OCCLUDERS)
    values = np.full((scene.n_frames, len(verts)), np.nan)
    for t in range(scene.n_frames):
        seen = seen_in(views, t, verts, normals, occluders, TOLERANCE)
        rows, columns, _, _ = views.pixels(t, verts[seen])
        image = evidence.targets.images[t].numpy()
        values[t, seen] = np.log(image[rows, columns].mean(-1) + _DARK)
    with warnings.catch_warnings():
        # Of vertices that never show.
        warnings.simplefilter("ignore", RuntimeWarning)
        values -= np.nanmedian(values, axis=0)
        for t in range(scene.n_frames):
            seen = np.isfinite(values[t])
            if seen.any():
                values[t, seen] -= _light(values[t, seen], normals[seen])
        values -= np.nanmedian(values, axis=0)
        spread = np.nanmedian(np.abs(values), axis=0)
        spread[np.isfinite(values).sum(axis=0) < _LEAST_SHOWN] = np.nan
        nearest = scipy.spatial.cKDTree(verts).query(verts, k=min(_AROUND, len(verts)))[1]
        return np.log(np.nanmedian(spread[nearest], axis=1) + 1e-3)


def _light(values: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The linear function [N] of normals [N, 3] with the least absolute difference from values [N]."""
    columns = np.column_stack([np.ones(len(normals)), normals])
    weights = np.ones(len(values))
    fitted = np.zeros(len(values))
    for _ in range(3):
        solution = np.linalg.lstsq(columns * weights[:, None], values * weights, rcond=None)[0]
        fitted = columns @ solution
        weights = np.maximum(np.abs(values - fitted), 0.05) ** -0.5
    return fitted


def _vertex_areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """A third of the area [V] of each vertex' faces."""
    return np.bincount(faces.ravel(), np.repeat(face_areas(verts, faces) / 3.0, 3), minlength=len(verts))


def _with_proof(faces: np.ndarray, chosen: np.ndarray, proof: np.ndarray, least: float) -> np.ndarray:
    """Those of the chosen vertices [V] (bool) whose connected patch has enough proof [V] in all."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    index = np.cumsum(chosen) - 1
    edges = index[edges[chosen[edges].all(axis=1)]]
    count = int(chosen.sum())
    graph = scipy.sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    patches = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    kept = chosen.copy()
    kept[chosen] = (np.bincount(patches, proof[chosen]) >= least)[patches]
    return kept
