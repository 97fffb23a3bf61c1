"""Keypoints become hands: near the truth, on their own sides, with gaps filled and marked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_hands import K, detect, pose_track, two_hands
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.base import HandTrack
from bigs.hand import HandModel
from bigs.metrics.pose import mpjpe, wrist_error
from bigs.preprocess.hands.fit import HandFitConfig
from bigs.preprocess.hands.keypoints import Keypoints
from bigs.preprocess.hands.sides import sort_sides
from bigs.preprocess.hands.skeleton import HandSkeleton
from bigs.preprocess.hands.tracks import HandEstimates, fit_hands
from bigs.types import MASK_VALUES, Side

FRAMES = 20
GAP = slice(8, 10)
SWAPPED = 4
SEED = 3
# A third of the usual steps.
QUICK = HandFitConfig(candidates=4, candidate_steps=30, exchanges=1, steps=150)


@pytest.fixture(scope="module")
def truth(both_hands: dict[Side, HandModel]) -> dict[Side, HandTrack]:
    return two_hands(both_hands, FRAMES, SEED)


@pytest.fixture(scope="module")
def joints(truth: dict[Side, HandTrack], both_hands: dict[Side, HandModel]) -> dict[Side, np.ndarray]:
    return {side: pose_track(both_hands[side], track) for side, track in truth.items()}


@pytest.fixture(scope="module")
def keypoints(joints: dict[Side, np.ndarray]) -> dict[Side, Keypoints]:
    """Noisy, without the right hand in two frames, sides swapped in one."""
    rng = np.random.default_rng(0)
    found = {side: detect(places, rng) for side, places in joints.items()}
    found["right"].confidence[GAP] = 0.0
    for field in ("points", "confidence"):
        right, left = (getattr(found[side], field) for side in ("right", "left"))
        right[SWAPPED], left[SWAPPED] = left[SWAPPED].copy(), right[SWAPPED].copy()
    return found


@pytest.fixture(scope="module")
def estimates(keypoints: dict[Side, Keypoints], both_hands: dict[Side, HandModel]) -> HandEstimates:
    return fit_hands(keypoints, K, both_hands, config=QUICK)


@pytest.mark.slow
def test_hands_are_found_to_the_accuracy_of_the_keypoints(
    estimates: HandEstimates, joints: dict[Side, np.ndarray], both_hands: dict[Side, HandModel]
) -> None:
    for side, track in estimates.tracks.items():
        found = pose_track(both_hands[side], track)
        assert mpjpe(found, joints[side]).mean() < 9.0
        assert mpjpe(found, joints[side]).max() < 25.0
        # Two pixels are 1.5 mm; the rest is size against depth, which one camera cannot tell apart.
        assert wrist_error(found, joints[side]).mean() < 50.0
        pixels = found @ K.T
        true = joints[side] @ K.T
        apart = np.linalg.norm(pixels[..., :2] / pixels[..., 2:] - true[..., :2] / true[..., 2:], axis=-1)
        assert np.median(apart[track.valid]) < 3.0


@pytest.mark.slow
def test_gaps_are_filled_along_the_arc_and_marked(estimates: HandEstimates) -> None:
    right, left = estimates.tracks["right"], estimates.tracks["left"]
    assert not right.valid[GAP].any() and right.valid.sum() >= FRAMES - 3
    assert left.valid.sum() >= FRAMES - 1
    before, after = (Rotation.from_rotvec(right.global_orient[t]) for t in (7, 10))
    third = before * Rotation.from_rotvec((before.inv() * after).as_rotvec() / 3)
    assert (third.inv() * Rotation.from_rotvec(right.global_orient[8])).magnitude() < 1e-6
    assert np.allclose(right.transl[8], (2 * right.transl[7] + right.transl[10]) / 3)
    assert any("frames 8-9" in note for note in estimates.notes)


@pytest.mark.slow
def test_both_hands_have_one_shape(estimates: HandEstimates) -> None:
    # The built-in left hand is the mirrored right one, so one shape has the same numbers.
    assert np.allclose(estimates.tracks["right"].betas, estimates.tracks["left"].betas, atol=1e-4)
    assert np.abs(estimates.tracks["right"].betas).max() < 3.0


@pytest.mark.slow
def test_swapped_sides_are_swapped_back(estimates: HandEstimates) -> None:
    assert f"hands: sides swapped back in frame {SWAPPED}" in estimates.notes


@pytest.mark.slow
def test_one_hand_alone(
    keypoints: dict[Side, Keypoints], joints: dict[Side, np.ndarray], both_hands: dict[Side, HandModel]
) -> None:
    left = Keypoints(keypoints["left"].points[6:16], keypoints["left"].confidence[6:16])
    found = fit_hands({"left": left}, K, both_hands, config=QUICK)
    assert found.tracks.keys() == {"left"}
    assert mpjpe(pose_track(both_hands["left"], found.tracks["left"]), joints["left"][6:16]).mean() < 12.0


def test_too_few_keypoints_are_refused(both_hands: dict[Side, HandModel]) -> None:
    confidence = np.zeros((5, 21))
    confidence[:, :4] = 1.0
    with pytest.raises(InputError, match="at least 8 joints"):
        fit_hands({"right": Keypoints(np.zeros((5, 21, 2)), confidence)}, K, both_hands)


def swap(hands: dict[Side, Keypoints], frames: list[int]) -> dict[Side, Keypoints]:
    copies = {side: Keypoints(h.points.copy(), h.confidence.copy()) for side, h in hands.items()}
    for t in frames:
        copies["right"].points[t], copies["left"].points[t] = (
            hands["left"].points[t],
            hands["right"].points[t],
        )
        copies["right"].confidence[t] = hands["left"].confidence[t]
        copies["left"].confidence[t] = hands["right"].confidence[t]
    return copies


@pytest.fixture
def clean(joints: dict[Side, np.ndarray]) -> dict[Side, Keypoints]:
    found: dict[Side, Keypoints] = {}
    for side, places in joints.items():
        pixels = places @ K.T
        found[side] = Keypoints(pixels[..., :2] / pixels[..., 2:], np.ones(places.shape[:2]))
    return found


@pytest.mark.parametrize("frames", [[], [0], [19], [5, 6, 7], [1, 4, 9, 13, 18]])
def test_swaps_are_found_without_masks(clean: dict[Side, Keypoints], frames: list[int]) -> None:
    found = sort_sides(swap(clean, frames))
    assert np.flatnonzero(found.swapped).tolist() == frames
    assert np.array_equal(found.hands["right"].points, clean["right"].points)


def test_masks_find_a_clip_that_is_swapped_throughout(clean: dict[Side, Keypoints]) -> None:
    masks = []
    for t in range(FRAMES):
        mask = np.zeros((360, 520), dtype=np.uint8)
        for side, value in (("right", MASK_VALUES["right"]), ("left", MASK_VALUES["left"])):
            column, row = clean[side].points[t].astype(int).T
            mask[np.clip(row, 0, 359), np.clip(column, 0, 519)] = value
        masks.append(mask)
    everywhere = list(range(FRAMES))
    assert not sort_sides(swap(clean, everywhere)).swapped.any()
    assert sort_sides(swap(clean, everywhere), masks).swapped.all()


def test_one_hand_found_twice_is_kept_once(clean: dict[Side, Keypoints]) -> None:
    doubled = {side: Keypoints(h.points.copy(), h.confidence) for side, h in clean.items()}
    doubled["left"].points[7] = clean["right"].points[7] + 1.0
    found = sort_sides(doubled)
    assert np.flatnonzero(found.doubled["left"]).tolist() == [7]
    assert not found.doubled["right"].any() and not found.swapped.any()
    assert found.hands["left"].confidence[7].max() == 0.0
    assert np.array_equal(found.hands["right"].points, clean["right"].points)


def test_the_skeleton_is_the_model(both_hands: dict[Side, HandModel]) -> None:
    right = both_hands["right"]
    skeleton = HandSkeleton(right)
    rng = torch.Generator().manual_seed(0)
    betas, angles = torch.randn(10, generator=rng), 0.3 * torch.randn(4, 15, 3, generator=rng)
    orient = torch.linalg.qr(torch.randn(4, 3, 3, generator=rng)).Q
    orient = orient * torch.linalg.det(orient)[:, None, None]
    wrist = torch.randn(4, 3, generator=rng)
    fingers = skeleton.fingers(angles) - right.hands_mean
    expected = right(betas, right.pose_matrices(fingers), orient, wrist).joints
    assert torch.allclose(skeleton.joints(betas, angles, orient, wrist), expected, atol=1e-6)


def test_bending_closes_the_hand_and_limits_are_costly(both_hands: dict[Side, HandModel]) -> None:
    skeleton = HandSkeleton(both_hands["right"])
    straight = torch.zeros(1, 15, 3)
    bent = straight.clone()
    bent[:, :12, 0] = 1.0
    place = (torch.zeros(10), torch.eye(3)[None], torch.zeros(1, 3))

    def tips(angles: torch.Tensor) -> torch.Tensor:
        return skeleton.joints(place[0], angles, *place[1:])[0, 17:]

    # The palm faces -y.
    assert (tips(bent)[:, 1] < tips(straight)[:, 1] - 0.02).all()
    assert (skeleton.unlikeliness(-bent) > skeleton.unlikeliness(bent) + 100).all()
    sideways = straight.clone()
    sideways[:, 1, 1] = 0.5
    assert (skeleton.unlikeliness(sideways) > skeleton.unlikeliness(straight) + 100).all()


def test_a_pose_with_posedirs_moves_the_tips(both_hands: dict[Side, HandModel]) -> None:
    right = both_hands["right"]
    fields = {name: getattr(right, name) for name in ("v_template", "faces", "shapedirs", "J_regressor")}
    fields |= {name: getattr(right, name) for name in ("lbs_weights", "hands_mean", "tip_vertex_ids")}
    generator = torch.Generator().manual_seed(1)
    posedirs = 1e-3 * torch.randn(right.posedirs.shape, generator=generator)
    model = HandModel("right", posedirs=posedirs, **fields)
    skeleton = HandSkeleton(model)
    angles = torch.full((1, 15, 3), 0.2)
    matrices = model.pose_matrices(skeleton.fingers(angles) - model.hands_mean)
    expected = model(torch.zeros(10), matrices, torch.eye(3)[None], torch.zeros(1, 3)).joints
    found = skeleton.joints(torch.zeros(10), angles, torch.eye(3)[None], torch.zeros(1, 3))
    assert torch.allclose(found, expected, atol=1e-6)
    plain = HandSkeleton(replace_posedirs(right, fields))
    assert not torch.allclose(
        plain.joints(torch.zeros(10), angles, torch.eye(3)[None], torch.zeros(1, 3)), found
    )


def replace_posedirs(right: HandModel, fields: dict[str, torch.Tensor]) -> HandModel:
    return HandModel("right", posedirs=torch.zeros_like(right.posedirs), **fields)


def test_notes_say_which_hand_is_left_out(clean: dict[Side, Keypoints]) -> None:
    confidence = np.zeros_like(clean["left"].confidence)
    confidence[:, :3] = 1.0
    hidden = replace(clean["left"], confidence=confidence)
    assert (sort_sides({"right": clean["right"], "left": hidden}).hands["left"].confidence > 0).sum() == 60
