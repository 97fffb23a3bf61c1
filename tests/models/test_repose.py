"""Other poses: what is not moved stays, and what is moved goes where the angles say."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from small_scene import FRAMES, make_scene

from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.models.playback import Playback, record
from bigs.models.repose import FINGERS, bend_fingers, repose, turn_object, wrist_of
from bigs.types import SIDES, Side

NAMES = tuple(map(str, range(FRAMES)))


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "with correctives"])
def playback(request: pytest.FixtureRequest) -> Playback:
    return record(make_scene(rich=request.param), "clip", NAMES, (0.0, 0.0, 0.0))


@pytest.mark.parametrize("side", SIDES)
def test_its_own_pose_changes_nothing(playback: Playback, side: Side) -> None:
    hand = playback.hands[side]
    again = repose(hand, side, hand.hand_pose, *wrist_of(hand))
    for name in ("verts", "joints", "bones", "global_orient_aa", "hand_pose_aa", "transl"):
        torch.testing.assert_close(getattr(again, name), getattr(hand, name), atol=2e-5, rtol=0)


@pytest.mark.parametrize("side", SIDES)
def test_a_wrist_that_moves_takes_the_hand_along(playback: Playback, side: Side) -> None:
    hand = playback.hands[side]
    orient, wrist = wrist_of(hand)
    moved = repose(hand, side, hand.hand_pose, orient, wrist + torch.tensor([0.1, 0.2, 0.3]))
    shift = torch.tensor([-0.1 if side == "left" else 0.1, 0.2, 0.3]).expand(FRAMES, 3)
    torch.testing.assert_close(moved.verts - hand.verts, shift[:, None].expand_as(hand.verts))
    torch.testing.assert_close(moved.joints - hand.joints, shift[:, None].expand_as(hand.joints))
    torch.testing.assert_close(moved.transl - hand.transl, shift)


@pytest.mark.parametrize("finger", FINGERS)
def test_only_the_finger_bends_and_by_its_angle(playback: Playback, finger: str) -> None:
    hand = playback.hands["left"]
    bent = bend_fingers(hand, "left", {finger: 20.0})
    still = [joint for name, joints in FINGERS.items() if name != finger for joint in joints]
    torch.testing.assert_close(bent.joints[:, [j + 1 for j in still]], hand.joints[:, [j + 1 for j in still]])
    knuckle, middle, last = (joint + 1 for joint in FINGERS[finger])
    before, after = (
        torch.nn.functional.normalize(h.joints[:, middle] - h.joints[:, knuckle], dim=-1)
        for h in (hand, bent)
    )
    angles = torch.rad2deg(torch.arccos((before * after).sum(-1)))
    torch.testing.assert_close(angles, torch.full((FRAMES,), 20.0), atol=0.05, rtol=0)
    assert (bent.joints[:, last] - hand.joints[:, last]).norm(dim=-1).min() > 0.003


def test_fingers_bend_towards_the_palm(playback: Playback) -> None:
    """At rest the palm of the canonical hand looks along -y."""
    hand = playback.hands["right"]
    flat = torch.eye(3).expand(FRAMES, 15, 3, 3)
    rest = repose(hand, "right", flat, torch.eye(3).expand(FRAMES, 3, 3), torch.zeros(FRAMES, 3))
    bent = bend_fingers(rest, "right", dict.fromkeys(FINGERS, 40.0))
    assert (bent.joints[:, 16:, 1] < rest.joints[:, 16:, 1] - 0.01).all()


def test_gaussians_follow_the_mesh(playback: Playback) -> None:
    hand = playback.hands["left"]
    bent = replace(playback, hands={"left": bend_fingers(hand, "left", {"index": 60.0})})
    frames = range(FRAMES)
    moved = (bent.gaussians(frames, ["left"]).means - playback.gaussians(frames, ["left"]).means).norm(dim=-1)
    reach = (bent.hands["left"].verts - hand.verts).norm(dim=-1).amax()
    assert moved.max() == pytest.approx(float(reach), rel=0.25)
    assert moved.median() < 0.2 * moved.max()  # the palm and the other fingers


def test_the_object_turns_about_its_middle(playback: Playback) -> None:
    obj = playback.object
    turned = turn_object(obj, axis_angle_to_matrix(torch.tensor([0.0, 0.0, math.pi / 2])))
    moved = replace(playback, object=turned)
    before, after = (torch.as_tensor(p.trajectory().object_verts) for p in (playback, moved))
    torch.testing.assert_close(after.mean(1), before.mean(1), atol=1e-6, rtol=0)
    assert (after - before).norm(dim=-1).max() > 0.02
    first, second = (p.gaussians([1], ["object"]).means[0] for p in (playback, moved))
    assert (first - second).norm(dim=-1).max() > 0.02


def test_a_part_of_the_clip_is_a_clip(playback: Playback) -> None:
    part = playback.at([2, 0])
    assert part.frame_names == ("2", "0")
    for mine, whole in zip(part.gaussians([0, 1]), playback.gaussians([2, 0]), strict=True):
        torch.testing.assert_close(mine, whole, atol=0, rtol=0)
    torch.testing.assert_close(
        torch.as_tensor(part.trajectory().verts["left"]), playback.hands["left"].verts[[2, 0]]
    )
