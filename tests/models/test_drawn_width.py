"""Fresh Gaussians cover as much of a picture as the surface that they stand for."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from posed_hands import pose_hand
from small_scene import HAND, OBJECT, hand_model

from bigs.fused.outline import covered_shares
from bigs.models.hand_splats import HandSplats
from bigs.models.object_splats import ObjectSplats, pose_object
from bigs.models.poses import HandFrames, ObjectFrames
from bigs.raster import rasterization
from bigs.types import Gaussians

DEPTH = 0.6
# Pixels that a decimetre takes at that depth: in pictures 240 wide, in which poses are found, and 480 wide.
FOUND_AT, SHOWN_AT = 75.0, 150.0


def camera(decimetre: float) -> tuple[torch.Tensor, int]:
    focal, size = 10.0 * DEPTH * decimetre, int(4.0 * decimetre)
    return torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]]), size


def areas(gaussians: Gaussians, verts: torch.Tensor, faces: torch.Tensor, decimetre: float) -> float:
    """What Gaussians cover of a picture, relative to what a mesh [1, V, 3] covers."""
    K, size = camera(decimetre)
    drawn = rasterization(*gaussians, torch.eye(4)[None], K[None], size, size).alphas
    return float(drawn.sum() / covered_shares(verts, faces, K, size, size).sum())


def hand_areas(turn: float, decimetre: float) -> float:
    model, betas = hand_model(), torch.zeros(10)
    turned = torch.tensor(trimesh.transformations.rotation_matrix(turn, [0.0, 1.0, 0.0])[:3, :3]).float()
    pose = HandFrames(turned[None], torch.eye(3).expand(1, 15, 3, 3), torch.tensor([[0.0, 0.0, DEPTH]]))
    torch.manual_seed(0)
    splats = HandSplats(model, replace(HAND, subdivisions=1))
    gaussians = pose_hand(model, splats(), betas, pose, "right")
    verts = model(betas, pose.hand_pose, pose.global_orient, pose.wrist).vertices
    return areas(gaussians, verts, model.faces, decimetre)


def object_areas(shape: trimesh.Trimesh, turn: float, decimetre: float) -> float:
    points, face = trimesh.sample.sample_surface_even(shape, 6000, seed=0)
    normals = np.asarray(shape.face_normals)[face]
    turned = torch.tensor(trimesh.transformations.rotation_matrix(turn, [1.0, 1.0, 0.0])[:3, :3]).float()
    frames = ObjectFrames(turned[None], torch.tensor([[0.0, 0.0, DEPTH]]), torch.tensor(1.0))
    splats = ObjectSplats(np.asarray(points), normals, np.full_like(normals, 0.5), OBJECT)
    gaussians = pose_object(splats(), frames)
    verts = torch.as_tensor(shape.vertices).float() @ turned.T + frames.centers
    return areas(gaussians, verts[None], torch.as_tensor(shape.faces), decimetre)


BOX = trimesh.creation.box((0.06, 0.04, 0.12))
BOTTLE = trimesh.creation.cylinder(0.035, 0.16)
SUBJECTS: dict[str, Callable[[float, float], float]] = {
    "hand": hand_areas,
    "box": lambda turn, decimetre: object_areas(BOX, turn, decimetre),
    "bottle": lambda turn, decimetre: object_areas(BOTTLE, turn, decimetre),
}


@pytest.mark.parametrize("subject", SUBJECTS)
@pytest.mark.parametrize("decimetre", [FOUND_AT, SHOWN_AT])
@torch.no_grad()
def test_it_is_drawn_as_wide_as_it_is(subject: str, decimetre: float) -> None:
    """A hand that is drawn 8 % too large would be put 4 % too far away."""
    for turn in (0.7, 1.5):
        assert SUBJECTS[subject](turn, decimetre) == pytest.approx(1.0, abs=0.04)
