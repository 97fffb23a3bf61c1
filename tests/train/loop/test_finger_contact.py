"""Fingers that hold the cube are drawn to it, each by itself, as surely as the grasp is."""

from __future__ import annotations

import copy

import pytest
import torch

from bigs.hand import HandModel
from bigs.losses.contact import surface_gaps
from bigs.models.scene import Scene
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.loop.terms import TERMS
from bigs.types import SIDES, Side


def loss(scene: Scene, evidence: Evidence) -> torch.Tensor:
    return TERMS["finger_contact"](Step(scene, evidence, {}, Selection(torch.arange(scene.n_frames))))


def hold(scene: Scene, side: Side, certainty: tuple[float, ...]) -> None:
    """Frames that are sure of it at all form one grasp."""
    sure = torch.tensor(certainty)
    frames = torch.arange(scene.n_frames)
    clip = scene.at(frames)
    of_frame = torch.where(sure > 0, 0, -1)
    scene.grasps[side].set(of_frame, 0.1, clip.canonical_hand(side), clip.object, sure)


def test_only_grasps_draw_fingers(scene: Scene, evidence: Evidence) -> None:
    assert loss(scene, evidence) == 0.0
    hold(scene, "left", (0.0, 0.0, 0.0))
    assert loss(scene, evidence) == 0.0
    hold(scene, "right", (1.0, 0.5, 0.0))
    assert loss(scene, evidence) > 0.1


def test_each_fingertip_counts_by_its_five_nearest_vertices(scene: Scene, evidence: Evidence) -> None:
    hold(scene, "right", (1.0, 0.5, 0.0))
    # A hand that is in no grasp changes nothing.
    clip = scene.at(torch.arange(scene.n_frames))
    own = clip.in_object_frame(clip.verts("right"))
    distance = clip.object.scale * scene.object_distance(own)
    tips = scene.hand_model("right").fingertips
    nearest = [distance[:, tip].topk(5, dim=1, largest=False).values.mean(1) for tip in tips]
    gaps = surface_gaps(torch.stack(nearest, dim=1)).mean(1)
    expected = (gaps[0] + 0.5 * gaps[1]) / 1.5
    assert loss(scene, evidence).item() == pytest.approx(expected.item(), rel=1e-4)


def test_a_step_downhill_brings_fingertips_nearer(scene: Scene, evidence: Evidence) -> None:
    hold(scene, "right", (1.0, 1.0, 1.0))
    pose = scene.grasps["right"].pose.requires_grad_(True)
    before = loss(scene, evidence)
    before.backward()
    # Bases, middle and outer joints of four fingers, and nothing of the thumb.
    assert pose.grad[:, :12].abs().amax(-1).gt(0).any(0).sum() >= 4
    assert not pose.grad[:, 12:].any()
    with torch.no_grad():
        pose -= 0.1 * pose.grad / pose.grad.norm()
    assert loss(scene, evidence) < before


def test_fingertips_are_the_outermost_segments(both_hands: dict[Side, HandModel]) -> None:
    for side in SIDES:
        hand = both_hands[side]
        template, joints = hand.v_template, hand.rest_joints(torch.zeros(10))
        assert len(hand.fingertips) == 4 and len(set().union(*hand.fingertips)) == sum(
            map(len, hand.fingertips)
        )
        # MANO's tips from the index on are index, middle, ring and pinky; its third joints index, middle,
        # pinky and ring.
        for tip, segment, outer in zip((1, 2, 4, 3), hand.fingertips, (3, 6, 9, 12), strict=True):
            assert int(hand.tip_vertex_ids[tip]) in segment
            length = (template[hand.tip_vertex_ids[tip]] - joints[outer]).norm()
            assert ((template[list(segment)] - joints[outer]).norm(dim=1) < 1.3 * length).all()


def test_a_finger_that_no_vertex_follows_has_no_tip(both_hands: dict[Side, HandModel]) -> None:
    stiff = copy.deepcopy(both_hands["right"])
    stiff.__dict__.pop("fingertips", None)
    stiff.lbs_weights[:, 6] = 0.0
    assert stiff.fingertips == tuple(both_hands["right"].fingertips[i] for i in (0, 2, 3))
