"""The clip's estimates in camera space: HOLD's own formula, smoothing, and frames that were filled in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from toy_clips import painted_clip

from bigs.data.base import Clip
from bigs.geometry.rotations import axis_angle_to_matrix, rotation_angle
from bigs.hand import HandModel, mirror_rotation
from bigs.train.plan.start_config import InitialConfig
from bigs.train.start.initial import (
    HandStart,
    hand_in_camera,
    initial_trajectory,
    object_in_camera,
    smooth_hand,
    smooth_object,
    touching_frames,
)
from bigs.types import SIDES, Side

FLIP = np.diag([1.0, -1.0, -1.0])


def skinned(model: HandModel, rotvecs: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V_mano and its joints of one frame, written out joint by joint in numpy: [V, 3] and [16, 3]."""
    rest = model.v_template.double().numpy() + model.shapedirs.double().numpy() @ betas
    joints = model.J_regressor.double().numpy() @ rest
    rotations = Rotation.from_rotvec(rotvecs).as_matrix()
    if model.has_posedirs:
        rest = rest + model.posedirs.double().numpy() @ (rotations[1:] - np.eye(3)).ravel()
    chain: list[np.ndarray] = []
    for j, parent in enumerate(model.parents):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] if j == 0 else joints[j] - joints[parent]
        chain.append(local if j == 0 else chain[parent] @ local)
    posed = np.stack([transform[:3, 3] for transform in chain])
    moved = [(rest - joints[j]) @ chain[j][:3, :3].T + chain[j][:3, 3] for j in range(16)]
    return np.einsum("vj,jvi->vi", model.lbs_weights.double().numpy(), np.stack(moved)), posed


@pytest.mark.parametrize("side", SIDES)
def test_hands_are_the_files_own_formula(side: Side, tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    """X_cv = F (V_mano(pose, betas) + hand_trans - n), each side by its own model."""
    track, model = tiny.hands[side], both_hands[side]
    found = initial_trajectory(tiny, both_hands)
    assert found.frame_names == tiny.frame_names
    for t in (0, 5, len(tiny) - 1):
        fingers = track.hand_pose[t] + model.hands_mean.double().numpy()
        verts, joints = skinned(model, np.vstack([track.global_orient[t], fingers]), track.betas)
        to_camera = lambda x, t=t: (x + track.transl[t] - tiny.normalize_shift) @ FLIP  # noqa: E731
        np.testing.assert_allclose(found.verts[side][t], to_camera(verts), atol=2e-5)
        np.testing.assert_allclose(found.joints[side][t, :16], to_camera(joints), atol=2e-5)
        tips = to_camera(verts)[model.tip_vertex_ids.numpy()]
        np.testing.assert_allclose(found.joints[side][t, 16:], tips, atol=2e-5)
    np.testing.assert_array_equal(found.faces[side], model.faces.numpy())


def test_the_object_is_the_files_own_formula(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    """X_cv = F (R (c D x) + t - n)."""
    track = tiny.object
    assert track is not None
    found = initial_trajectory(tiny, both_hands).object_verts
    assert found is not None
    canonical = np.c_[track.points, np.ones(len(track.points))] @ track.metric_from_canon.T
    for t in (0, 7):
        world = canonical[:, :3] @ track.rotations[t].T + track.transl[t]
        np.testing.assert_allclose(found[t], (world - tiny.normalize_shift) @ FLIP, atol=1e-6)


def test_what_is_absent_is_absent(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    left = replace(tiny, hands={"left": tiny.hands["left"]}, object=None)
    found = initial_trajectory(left, both_hands)
    assert set(found.verts) == set(found.joints) == {"left"}
    assert found.object_verts is None


def test_the_left_hand_is_kept_as_a_right_one(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    """Posing the canonical right hand in the mirror gives the left hand's own pose."""
    config = InitialConfig()
    start = hand_in_camera(tiny.hands["left"], tiny.cam_from_world, both_hands["left"], config)
    expected = initial_trajectory(tiny, both_hands).joints["left"]
    betas = torch.as_tensor(tiny.hands["left"].betas, dtype=torch.float32)
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    out = both_hands["right"](betas, start.hand_pose, start.global_orient, start.wrist * mirror)
    np.testing.assert_allclose((out.joints * mirror).numpy(), expected, atol=2e-5)
    np.testing.assert_allclose(start.wrist.numpy(), expected[:, 0], atol=1e-5)
    assert mirror_rotation(mirror_rotation(start.global_orient)).allclose(start.global_orient)


def test_object_points_lie_about_their_middle(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    start = object_in_camera(tiny, InitialConfig())
    np.testing.assert_allclose(start.points.min(0), -start.points.max(0), atol=1e-9)
    cam = start.points @ start.rotations.double().numpy().transpose(0, 2, 1)
    cam = cam + start.centers.double().numpy()[:, None]
    everything = initial_trajectory(tiny, both_hands).object_verts
    assert everything is not None
    # Stray points are left out; what is kept is where the file has it.
    assert 0.8 * everything.shape[1] < cam.shape[1] <= everything.shape[1]
    for t in (0, 9):
        distance = np.linalg.norm(cam[t, ::40, None] - everything[t, None], axis=-1).min(axis=1)
        assert distance.max() < 1e-5


def test_frames_that_were_filled_in_are_hardly_trusted(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    track = tiny.hands["right"]
    valid = np.ones(len(tiny), dtype=bool)
    valid[2] = False
    transl = track.transl + 0.01 * np.random.default_rng(0).normal(size=track.transl.shape)
    transl[7] = 0.5 * (transl[6] + transl[8])  # nobody says so, but this frame is a straight line
    config = InitialConfig(interpolated_trust=0.25)
    gaps = replace(track, valid=valid, transl=transl)
    trust = hand_in_camera(gaps, tiny.cam_from_world, both_hands["right"], config).trust
    assert trust.tolist() == [0.25 if t in (2, 7) else 1.0 for t in range(len(tiny))]


def jitter(values: torch.Tensor) -> float:
    second = values[2:] - 2 * values[1:-1] + values[:-2]
    return second.flatten(1).norm(dim=-1).mean().item()


def test_smoothing_lowers_jitter(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    for side in SIDES:
        start = hand_in_camera(tiny.hands[side], tiny.cam_from_world, both_hands[side], InitialConfig())
        smooth = smooth_hand(start, 2.0)
        assert jitter(smooth.wrist) < 0.8 * jitter(start.wrist)
        for after, before in (
            (smooth.global_orient, start.global_orient),
            (smooth.hand_pose, start.hand_pose),
        ):
            assert jitter(after) < 0.8 * jitter(before)
            eye = after @ after.transpose(-1, -2)
            torch.testing.assert_close(eye, torch.eye(3).expand_as(eye), atol=1e-5, rtol=0)
    obj = object_in_camera(tiny, InitialConfig())
    smoothed = smooth_object(obj, 2.0)
    assert jitter(smoothed.centers) < 0.8 * jitter(obj.centers)
    assert jitter(smoothed.rotations) < jitter(obj.rotations)
    assert smoothed.points is obj.points


def test_smoothing_nears_the_truth_of_a_slow_motion() -> None:
    """Noise of depth is larger than that across the image, and is smoothed apart from it."""
    frames = 40
    generator = torch.Generator().manual_seed(0)
    t = torch.linspace(0, 1, frames)[:, None]
    true = torch.cat([0.1 * torch.sin(3 * t), 0.1 * t, 0.6 + 0.05 * torch.cos(3 * t)], dim=1)
    noise = torch.tensor([0.002, 0.002, 0.02]) * torch.randn(frames, 3, generator=generator)
    turn = axis_angle_to_matrix(t * torch.tensor([0.5, 1.0, 0.0]))
    shaken = turn @ axis_angle_to_matrix(0.1 * torch.randn(frames, 3, generator=generator))
    fingers = torch.eye(3).expand(frames, 15, 3, 3)
    smooth = smooth_hand(HandStart(shaken, fingers, true + noise, torch.ones(frames)), 2.0)
    error = (smooth.wrist - true).abs().mean(0)
    assert (error < 0.6 * noise.abs().mean(0)).all()
    angles = [
        rotation_angle(turn.transpose(-1, -2) @ found).mean() for found in (smooth.global_orient, shaken)
    ]
    assert angles[0] < 0.6 * angles[1]


def test_no_smoothing_changes_nothing(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    start = hand_in_camera(tiny.hands["left"], tiny.cam_from_world, both_hands["left"], InitialConfig())
    for before, after in zip(start, smooth_hand(start, 0.0), strict=True):
        torch.testing.assert_close(after, before)


def test_an_outlier_is_smoothed_away() -> None:
    frames = 15
    line = torch.linspace(0, 0.3, frames)[:, None] * torch.tensor([1.0, 0.5, 0.2]) + torch.tensor(
        [0.0, 0.0, 0.5]
    )
    line = line + 1e-4 * torch.randn(frames, 3, generator=torch.Generator().manual_seed(0))
    broken = line.clone()
    broken[7] += torch.tensor([0.2, -0.1, 0.1])
    still = torch.eye(3).expand(frames, 3, 3)
    start = HandStart(still, still[:, None].expand(-1, 15, -1, -1), broken, torch.ones(frames))
    assert (smooth_hand(start, 2.0).wrist - line).norm(dim=-1).max() < 0.01


def test_touching_frames(tmp_path: Path) -> None:
    """Touch is a gap of at most `reach` pixels between the two masks."""
    gaps = [0, 1, 2, 3, 4, 8]
    masks = np.zeros((len(gaps) + 2, 30, 40), dtype=np.uint8)
    for t, gap in enumerate(gaps):
        masks[t, 10:20, 5:10] = 150
        masks[t, 10:20, 10 + gap : 16 + gap] = 50
    masks[-2, 10:20, 5:10] = 150  # no object
    masks[-1, 10:20, 5:10] = 50  # no hand
    clip = painted_clip(tmp_path, np.zeros((*masks.shape, 3), np.uint8), masks)
    assert touching_frames(clip, "right").tolist() == [True, True, True, False, False, False, False, False]
    assert touching_frames(clip, "right", reach=1).tolist() == [True] + 7 * [False]
    assert not touching_frames(clip, "left").any()
