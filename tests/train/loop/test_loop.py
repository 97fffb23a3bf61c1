"""The loop: which frames, what moves, when it stops, and what its terms say."""

from __future__ import annotations

import copy
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from toy_denoisers import LinearDenoiser
from toy_stages import ALONE, TOGETHER, held_cube, random_evidence, values

from bigs.checks import InputError
from bigs.hand import HandModel
from bigs.losses.mask import alpha_outside_masks, label_difference, outside_mask
from bigs.losses.photometric import masked_l1, masked_mse
from bigs.models.hand_detail import free_hand
from bigs.models.object_detail import split_object
from bigs.models.scene import Scene
from bigs.train.grasps.find import find_grasps
from bigs.train.loop.optim import GROUPS, group_parameters
from bigs.train.loop.run_stage import (
    StageProgress,
    choose_frames,
    run_stage,
    stage_entities,
)
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.loop.targets import Targets
from bigs.train.loop.terms import IMAGE_TERMS, TERMS
from bigs.train.plan.config import GraspStage, OptimizeStage
from bigs.types import Side

# --- frames ---


@pytest.mark.parametrize(("n_frames", "count"), [(12, 3), (12, 5), (7, 2), (7, 6), (5, 1), (30, 7)])
def test_every_pass_visits_every_frame(n_frames: int, count: int) -> None:
    stage = replace(ALONE, frames_per_step=count)
    per_pass = -(-n_frames // count)
    orders = []
    for first in range(0, 4 * per_pass, per_pass):
        batches = [
            choose_frames(n_frames, stage, 3, step).tolist() for step in range(first, first + per_pass)
        ]
        for batch in batches:
            assert len(set(batch)) == count
            assert batch == sorted(batch)
        visits = Counter(frame for batch in batches for frame in batch)
        assert set(visits) == set(range(n_frames))
        assert max(visits.values()) <= 2
        assert sum(visits.values()) == per_pass * count
        orders.append(batches)
    assert len({str(batches) for batches in orders}) > 1  # passes are shuffled anew


def test_frames_are_a_function_of_seed_and_step() -> None:
    stage = replace(ALONE, frames_per_step=4)
    first = [choose_frames(20, stage, 7, step).tolist() for step in range(15)]
    torch.manual_seed(99)  # the global generator has no say
    again = [choose_frames(20, stage, 7, step).tolist() for step in reversed(range(15))][::-1]
    assert first == again
    assert first != [choose_frames(20, stage, 8, step).tolist() for step in range(15)]


@pytest.mark.parametrize("count", [0, 9, 40])
def test_a_step_may_take_the_whole_clip(count: int) -> None:
    assert choose_frames(9, replace(ALONE, frames_per_step=count), 0, 5).tolist() == list(range(9))


# --- what moves ---


@pytest.mark.parametrize("stage", [ALONE, TOGETHER], ids=lambda stage: stage.name)
def test_listed_groups_change_and_others_do_not(
    scene: Scene, evidence: Evidence, stage: OptimizeStage
) -> None:
    before = values(scene)
    listed = {id(p) for group in stage.lrs for p in group_parameters(scene, group)}
    run_stage(scene, stage, evidence, 0)
    changed = {name for name, p in scene.named_parameters() if not torch.equal(p, before[name])}
    expected = {name for name, p in scene.named_parameters() if id(p) in listed}
    assert changed <= expected
    # Every listed group has moved; decoders move from their last layer on.
    for group in stage.lrs:
        assert {
            n for n, p in scene.named_parameters() if any(p is q for q in group_parameters(scene, group))
        } & (changed), group


@pytest.mark.parametrize("group", [g for g in GROUPS if g not in ("hand.skinning", "object.depth")])
def test_every_group_can_be_reached_by_some_term(scene: Scene, evidence: Evidence, group: str) -> None:
    """A group whose rate does nothing would be a knob without a wire."""
    stage = replace(
        TOGETHER, steps=2, lrs={group: 1e-2}, weights={"image": 1.0, "silhouette": 1.0, "rigid": 1.0}
    )
    if group.startswith("scene"):
        stage = replace(stage, lrs={group: 1e-2, "hand.color": 1e-3})
    if group.split(".")[1] in ("shift", "size", "opacity", "color"):
        scene.object_splats = split_object(scene.object_splats(), 1, 0.0)
        scene.hand_splats["right"] = free_hand(scene.hand_splats["right"])
    if "grasp" in group or group == "object.scale":
        find_grasps(scene, GraspStage(least=2), evidence.touching)
    # A fresh decoder's last layer is zero, so what lies below it gets a gradient from the second step on.
    if group.endswith("triplane"):
        stage = replace(stage, lrs={group: 1e-2, group.replace("triplane", "appearance"): 1e-2})
    before = values(scene)
    run_stage(scene, stage, evidence, 0)
    mine = [n for n, p in scene.named_parameters() if any(p is q for q in group_parameters(scene, group))]
    assert any(not torch.equal(dict(scene.named_parameters())[name], before[name]) for name in mine)


def test_free_frames_alone_move(scene: Scene, evidence: Evidence) -> None:
    """Each hand where it holds nothing; a hand that always holds is not looked at."""
    scene.grasps["right"].of_frame.copy_(torch.tensor([0, 0, -1]))
    scene.grasps["left"].of_frame.fill_(0)
    lrs = {f"hand.{name}": 1e-3 for name in ("orient", "pose", "ray", "depth")}
    weights = {"image": 1.0, "silhouette": 1.0, "acceleration": 1.0, "pose_prior": 1.0, "orient_prior": 1.0}
    with torch.no_grad():  # so that priors and smoothness pull at every frame
        for poses in scene.hand_poses.values():
            for residual in (poses.orient, poses.pose, poses.position.ray):
                residual.copy_(0.01 * torch.randn(residual.shape, generator=torch.Generator().manual_seed(3)))
    before = values(scene)
    stage = replace(ALONE, lrs=lrs, weights=weights, free_frames=True)
    assert stage_entities(scene, stage) == ("right",)
    run_stage(scene, stage, evidence, 0)
    for name, now in scene.named_parameters():
        if name.startswith("hand_poses.right.") and name.split(".", 2)[2] != "pose_bias":
            assert torch.equal(now[:2], before[name][:2]), name
            assert not torch.equal(now[2], before[name][2]), name
        else:
            assert torch.equal(now, before[name]), name


def test_pixels_that_count_say_what_whole_images_say(scene: Scene, evidence: Evidence) -> None:
    """Terms that look at each pixel for itself leave out those that are black and should be."""
    targets = evidence.targets
    shares = {entity: share * (torch.arange(40) < 25) for entity, share in targets.shares.items()}
    evidence = replace(evidence, targets=replace(targets, shares=shares))
    frames = torch.tensor([0, 2])
    step = Step(scene, evidence, scene.canonical(scene.entities), Selection(frames, scene.entities))
    seen = (step.together.alphas[..., 0] > 0) | (evidence.targets.foreground[frames] > 0)
    assert seen.any() and not seen.all()
    rendered, foreground = step.together.colors, evidence.targets.foreground[frames]
    labels = torch.stack([shares[entity][frames] for entity in scene.entities], dim=-1)
    images = targets.images[frames]
    whole = {
        "image": masked_l1(rendered[..., :3], images, foreground),
        "mse": masked_mse(rendered[..., :3], images, foreground),
        "alpha_outside": alpha_outside_masks(
            step.together.alphas.flatten(0, 2), 1.0 - foreground.flatten(), foreground
        ),
        "labels": label_difference(rendered[..., 3:], labels),
    }
    for name, value in whole.items():
        torch.testing.assert_close(IMAGE_TERMS["interacting-subjects"][name](step), value)
        assert value > 0.0, name


@pytest.mark.parametrize("name", ["image", "mse", "alpha_outside", "labels"])
def test_what_a_sleeve_covers_says_nothing(scene: Scene, evidence: Evidence, name: str) -> None:
    """No term of single pixels pulls at what is rendered there."""
    targets = evidence.targets
    nothing = {entity: torch.zeros_like(share) for entity, share in targets.shares.items()}
    covered = replace(targets, shares=nothing, unknown=torch.ones_like(targets.unknown))
    bare = replace(targets, shares=nothing, unknown=torch.zeros_like(targets.unknown))

    def term(targets: Targets) -> Tensor:
        selection = Selection(torch.tensor([0, 2]), scene.entities)
        canonical = scene.canonical(scene.entities)
        step = Step(scene, replace(evidence, targets=targets), canonical, selection)
        return IMAGE_TERMS["interacting-subjects"][name](step)

    assert term(covered) == 0.0
    if name in ("alpha_outside", "labels"):
        assert term(bare) > 0.0


def test_the_papers_mask_term_counts_what_a_sleeve_covers(scene: Scene, evidence: Evidence) -> None:
    """Its form is (1 - m) over the whole image."""
    targets, frames = evidence.targets, torch.tensor([0, 2])
    covered = replace(targets, unknown=1.0 - targets.foreground)
    evidence, selection = replace(evidence, targets=covered), Selection(frames, scene.entities)
    step = Step(scene, evidence, scene.canonical(scene.entities), selection)
    expected = outside_mask(step.together.colors[..., :3], targets.foreground[frames])
    assert IMAGE_TERMS["interacting-subjects"]["mask"](step) == expected > 0.0


def test_skinning_and_depth_are_reached_too(scene: Scene, evidence: Evidence) -> None:
    with torch.no_grad():  # bent fingers, so that weights matter
        for poses in scene.hand_poses.values():
            poses.pose.fill_(0.3)
    lrs = {"hand.skinning": 1e-2, "object.depth": 1e-2}
    stage = replace(TOGETHER, steps=1, lrs=lrs, weights={"image": 1.0, "rigid": 1.0, "contact": 1.0})
    before = values(scene)
    run_stage(scene, stage, evidence, 0)
    changed = {name for name, p in scene.named_parameters() if not torch.equal(p, before[name])}
    assert "object_poses.position.log_depth" in changed
    assert any("skinning" in name for name in changed)


def test_alone_only_what_moves_is_rendered(scene: Scene) -> None:
    assert stage_entities(scene, ALONE) == ("right", "left", "object")
    assert stage_entities(scene, replace(ALONE, lrs={"hand.ray": 1.0})) == ("right", "left")
    assert stage_entities(scene, replace(ALONE, lrs={"object.ray": 1.0})) == ("object",)
    assert stage_entities(scene, replace(TOGETHER, lrs={"hand.ray": 1.0})) == ("right", "left", "object")


# --- how often fields are evaluated ---


def count_calls(scene: Scene) -> Counter[str]:
    calls: Counter[str] = Counter()

    def counter(name: str) -> Any:
        return lambda module, inputs: calls.update([name])

    scene.hand_splats["right"].register_forward_pre_hook(counter("hand"))
    scene.object_splats.register_forward_pre_hook(counter("object"))
    return calls


@pytest.mark.parametrize(
    ("lrs", "weights", "expected"),
    [
        ({"hand.ray": 1e-3}, {"image": 1.0}, {"hand": 1, "object": 1}),
        ({"hand.ray": 1e-3, "hand.color": 1e-3}, {"image": 1.0}, {"hand": 5, "object": 1}),
        ({"hand.ray": 1e-3, "object.geometry": 1e-3}, {"labels": 1.0}, {"hand": 1, "object": 5}),
        ({"hand.ray": 1e-3}, {"silhouette": 1.0, "rigid": 1.0}, {}),
    ],
)
def test_frozen_fields_are_evaluated_once(
    scene: Scene,
    evidence: Evidence,
    lrs: dict[str, float],
    weights: dict[str, float],
    expected: dict[str, int],
) -> None:
    """Two hands and several frames share one evaluation of a field that moves."""
    calls = count_calls(scene)
    told: list[StageProgress] = []
    stage = replace(TOGETHER, steps=5, lrs=lrs, weights=weights)
    run_stage(scene, stage, evidence, 0, after_step=lambda progress, state: told.append(progress))
    assert calls == expected
    # The first step pays for all.
    spared = [progress.fields_spared for progress in told]
    assert spared[0] == 0.0 and len(set(spared[1:])) == 1
    assert (spared[1] > 0.0) == (1 in expected.values())


def test_adam_forgets_as_the_stage_says(scene: Scene, evidence: Evidence) -> None:
    ends = []
    for betas in ((0.8, 0.99), (0.5, 0.99), (0.8, 0.9)):
        start = copy.deepcopy(scene)
        run_stage(start, replace(ALONE, steps=3, adam_betas=betas), evidence, 0)
        ends.append(torch.cat([values.ravel() for values in start.parameters()]))
    assert not torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], ends[2])


# --- what a hook sees ---


def test_the_hook_sees_every_step(scene: Scene, evidence: Evidence) -> None:
    seen: list[StageProgress] = []
    final = run_stage(scene, ALONE, evidence, 0, after_step=lambda progress, state: seen.append(progress))
    assert [progress.step for progress in seen] == [1, 2, 3]
    assert final.step == 3
    for progress in seen:
        assert progress.steps == ALONE.steps
        assert progress.terms.keys() == ALONE.weights.keys()
        total = sum(ALONE.weights[name] * value for name, value in progress.terms.items())
        assert progress.loss == pytest.approx(total, rel=1e-5)
        assert progress.seconds > 0


# --- what terms say ---


def test_score_distillation_reaches_the_objects_field(scene: Scene, evidence: Evidence) -> None:
    """Rendered at the size of the prior's encoder; the hands' fields get nothing of it."""
    sizes: list[tuple[int, ...]] = []

    class Prior(LinearDenoiser):
        def encode(self, images: Tensor) -> Tensor:
            sizes.append(tuple(images.shape))
            return super().encode(images)

    evidence = replace(evidence, denoiser=Prior(24, dtype=torch.float32))
    lrs = {"object.triplane": 1e-2, "object.appearance": 1e-2, "object.geometry": 1e-2, "hand.triplane": 1e-2}
    stage = replace(ALONE, steps=2, lrs=lrs, weights={"sds": 1.0})
    before = values(scene)
    run_stage(scene, stage, evidence, 0)
    assert sizes == [(1, 3, 24, 24)] * 2
    after = values(scene)
    moved = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert moved == {"object_splats"}
    with pytest.raises(InputError, match="expected a prior's model for the term 'sds', found none"):
        run_stage(scene, stage, replace(evidence, denoiser=None), 0)


def test_the_papers_smoothness_is_of_fingers_and_wrist_alone(scene: Scene, evidence: Evidence) -> None:
    step = Step(scene, evidence, {}, Selection(torch.arange(scene.n_frames)))
    still = TERMS["smooth"](step)
    with torch.no_grad():
        for poses in scene.hand_poses.values():
            poses.orient[1] = 0.5
    step = Step(scene, evidence, {}, Selection(torch.arange(scene.n_frames)))
    assert TERMS["smooth"](step) == still
    with torch.no_grad():
        for poses in scene.hand_poses.values():
            poses.pose[1] = 0.5
    step = Step(scene, evidence, {}, Selection(torch.arange(scene.n_frames)))
    assert TERMS["smooth"](step) > still + 1.0


# The bend of a hand's index at the start (joint, axis, radians), and what of it may be left.
@pytest.mark.parametrize(
    ("term", "joint", "axis", "angle", "left"),
    [("joint_axes", 0, 0, 0.5, 0.2), ("finger_tendons", 2, 2, 0.9, 0.8)],
    ids=["a twist about the bone is turned back", "a tip follows its tendon"],
)
def test_priors_on_fingers_move_both_hands(
    scene: Scene, evidence: Evidence, term: str, joint: int, axis: int, angle: float, left: float
) -> None:
    with torch.no_grad():
        for poses in scene.hand_poses.values():
            poses.pose[:, joint, axis] = angle
    stage = replace(ALONE, steps=40, lrs={"hand.pose": 0.05}, weights={term: 1.0})
    losses: list[float] = []
    run_stage(scene, stage, evidence, 0, after_step=lambda p, _: losses.append(p.loss))
    assert losses[-1] < 0.1 * losses[0]
    for poses in scene.hand_poses.values():
        assert poses.pose[:, joint, axis].abs().max() < left


def test_every_term_is_a_finite_number(scene: Scene, evidence: Evidence) -> None:
    """On an ordinary scene, each term alone can be asked for and can be differentiated."""
    evidence = replace(evidence, denoiser=LinearDenoiser(24, dtype=torch.float32))
    for step, image_terms in IMAGE_TERMS.items():
        for name in (*image_terms, *TERMS):
            lrs = {group: 1e-4 for group in GROUPS}
            stage = replace(ALONE, step=step, steps=1, lrs=lrs, weights={name: 1.0})
            seen: list[float] = []
            run_stage(scene, stage, evidence, 0, after_step=lambda p, _, seen=seen: seen.append(p.loss))
            assert seen[0] >= 0, name
            assert all(torch.isfinite(p).all() for p in scene.parameters()), name


@pytest.mark.parametrize("term", ["perceptual", "mask_random"])
def test_what_terms_draw_depends_on_seed_and_step_alone(scene: Scene, evidence: Evidence, term: str) -> None:
    """A run that goes on after an interruption draws what it would have drawn."""
    stage = replace(ALONE, steps=3, lrs={"hand.ray": 0.0}, weights={term: 1.0}, frames_per_step=0)

    def losses(seed: int) -> list[float]:
        seen: list[float] = []
        run_stage(scene, stage, evidence, seed, after_step=lambda p, _: seen.append(p.loss))
        return seen

    first = losses(0)
    assert len(set(first)) == 3  # nothing moves, so only what is drawn differs
    torch.rand(5)
    assert losses(0) == first
    assert not set(losses(1)) & set(first)


@pytest.mark.parametrize("own", [True, False])
def test_a_frame_moves_on_without_being_looked_at_unless_its_moments_are_its_own(
    both_hands: dict[Side, HandModel], own: bool
) -> None:
    stage = replace(
        ALONE, lrs={"hand.pose": 0.1}, weights={"image": 1.0}, frames_per_step=1, frame_moments=own
    )
    poses = []
    for steps in (1, 2):
        scene = held_cube(both_hands)
        run_stage(scene, replace(stage, steps=steps), random_evidence(scene), 0)
        poses.append(scene.hand_poses["right"].pose[choose_frames(scene.n_frames, stage, 0, 0)])
    assert torch.any(poses[0] != 0)
    assert torch.equal(*poses) == own
