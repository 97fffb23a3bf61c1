"""Clips that show one side of their object: a window of a whole clip's frames, and the points seen in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from bigs.data.base import Clip
from bigs.data.excerpt import excerpt
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.fit import fit
from bigs.train.loop.evidence import EvidenceSource
from bigs.train.loop.step import Evidence
from bigs.train.loop.target_source import TargetSource
from bigs.train.plan.config import OptimizeStage, RefineStage, RunConfig
from bigs.types import MASK_VALUES, HandObjectTrajectory, Side


def fitted_view(
    clip: Clip,
    truth: HandObjectTrajectory,
    frames: range,
    hand_models: Mapping[Side, HandModel],
    plan: RunConfig,
    stage: OptimizeStage | RefineStage,
) -> tuple[Scene, Evidence]:
    """A scene that `plan` fitted to such a view without unlabelled occluders, and what `stage` looks at."""
    clip = limited_view(clip, truth, frames)
    scene, _ = fit(clip, hand_models, plan)
    nothing = np.zeros((len(clip), clip.height, clip.width), dtype=bool)
    return scene, EvidenceSource(TargetSource(clip, nothing), scene, plan, None).evidence(stage)


def limited_view(clip: Clip, truth: HandObjectTrajectory, frames: range) -> Clip:
    """The clip's `frames` only; the object keeps the points that face the camera and show in two of them."""
    index = np.array(frames)
    normals = np.asarray(
        trimesh.Trimesh(truth.object_verts[0], truth.object_faces, process=False).vertex_normals
    )
    to_cam = clip.cam_from_world
    points = np.einsum("tij,tnj->tni", to_cam[:, :3, :3], clip.object.points_world()) + to_cam[:, None, :3, 3]
    scale = np.median(
        np.linalg.norm(truth.object_verts.mean(1), axis=-1) / np.linalg.norm(points.mean(1), axis=-1)
    )
    nearest = cKDTree(truth.object_verts[0]).query(scale * points[0])[1]
    seen = np.zeros(len(nearest), dtype=int)
    to_first = truth.object_verts[0] - truth.object_verts[0].mean(0)
    for t in index:
        # The normals of frame t: those of frame 0 under the rotation between the two.
        here = truth.object_verts[t] - truth.object_verts[t].mean(0)
        u, _, v = np.linalg.svd(here.T @ to_first)
        facing = -(normals[nearest] @ (u @ v).T * points[t]).sum(-1) > 0.3 * np.linalg.norm(
            points[t], axis=-1
        )
        pixels = (points[t] @ clip.K.T)[:, :2] / points[t][:, 2:]
        column, row = np.floor(pixels).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < clip.width) & (row < clip.height)
        shown = np.zeros(len(points[t]), dtype=bool)
        shown[inside] = clip.mask(t)[row[inside], column[inside]] == MASK_VALUES["object"]
        seen += facing & shown
    keep = seen >= 2
    part = excerpt(clip, index)
    obj = part.object
    colors = None if obj.colors is None else obj.colors[keep]
    return replace(part, object=replace(obj, points=obj.points[keep], colors=colors))
