"""A fresh hand's Gaussians cover as much of a picture as its mesh."""

from dataclasses import replace

import pytest
import torch
from posed_hands import pose_hand
from small_scene import HAND, hand_model

from bigs.fused.outline import covered_shares
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.models.hand_splats import HandSplats
from bigs.models.poses import HandFrames
from bigs.raster import rasterization

DEPTH = 0.6
# Pixels that a decimetre takes at that depth: in pictures 240 wide, in which poses are found, and 480 wide.
FOUND_AT, SHOWN_AT = 75.0, 150.0


def camera(decimetre: float) -> tuple[torch.Tensor, int]:
    focal, size = 10.0 * DEPTH * decimetre, int(4.0 * decimetre)
    return torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]]), size


def hand_areas(subdivisions: int, turn: float, decimetre: float) -> float:
    """What its Gaussians cover of a picture, relative to what its mesh covers."""
    model, betas = hand_model(), torch.zeros(10)
    turned = axis_angle_to_matrix(torch.tensor([[0.0, turn, 0.0]]))
    pose = HandFrames(turned, torch.eye(3).expand(1, 15, 3, 3), torch.tensor([[0.0, 0.0, DEPTH]]))
    torch.manual_seed(0)
    splats = HandSplats(model, replace(HAND, subdivisions=subdivisions))
    gaussians = pose_hand(model, splats(), betas, pose, "right")
    verts = model(betas, pose.hand_pose, pose.global_orient, pose.wrist).vertices
    K, size = camera(decimetre)
    drawn = rasterization(*gaussians, torch.eye(4)[None], K[None], size, size).alphas
    return float(drawn.sum() / covered_shares(verts, model.faces, K, size, size).sum())


@pytest.mark.parametrize("decimetre", [FOUND_AT, SHOWN_AT])
@pytest.mark.parametrize("turn", [0.0, 0.7, 1.5])
@pytest.mark.parametrize("subdivisions", [0, 1])
@torch.no_grad()
def test_a_hand_is_drawn_as_wide_as_it_is(subdivisions: int, turn: float, decimetre: float) -> None:
    """One that is drawn 8 % too large would be put 4 % too far away."""
    assert hand_areas(subdivisions, turn, decimetre) == pytest.approx(1.0, abs=0.03)
