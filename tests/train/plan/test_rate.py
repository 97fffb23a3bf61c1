"""Plans at other rates than the usual: the same motion is judged alike, however often it is looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bigs.losses.temporal import acceleration, velocity
from bigs.motion.bundle import Bundle, BundleConfig, alike, cost_of, make_problem
from bigs.train.check_plan import check_plan
from bigs.train.plan.config import GraspStage, MoveStage, ObjectMotionStage, OptimizeStage
from bigs.train.plan.presets import PRESETS
from bigs.train.plan.rate import at_rate
from bigs.train.plan.start_config import InitialConfig
from bigs.types import USUAL_FPS

FAST = PRESETS["fast"]
STAGE = next(s for s in FAST.stages if isinstance(s, OptimizeStage))


def stage_at(fps: float, stage: object) -> object:
    return at_rate(replace(FAST, stages=(stage,)), fps).stages[0]  # type: ignore[arg-type]


def weight_at(fps: float, term: str) -> float:
    changed = stage_at(fps, replace(STAGE, weights={term: 1.0}))
    assert isinstance(changed, OptimizeStage)
    return changed.weights[term]


def test_the_usual_rate_changes_nothing() -> None:
    for plan in PRESETS.values():
        assert at_rate(plan, USUAL_FPS) == plan


@pytest.mark.parametrize("fps", [0.1, 5.0, 12.5, 24.0, 29.97, 60.0, 240.0])
@pytest.mark.parametrize("name", PRESETS)
def test_plans_stay_sound_at_any_rate(name: str, fps: float) -> None:
    check_plan(at_rate(PRESETS[name], fps))


def test_a_second_holds_half_as_many_frames() -> None:
    plan = at_rate(FAST, 15.0)
    usual = InitialConfig()
    assert (plan.initial.smooth_hands, plan.initial.smooth_object) == (
        usual.smooth_hands / 2,
        usual.smooth_object / 2,
    )
    grasps = next(s for s in plan.stages if isinstance(s, GraspStage))
    assert (grasps.least, grasps.gap, grasps.longest_move, grasps.alike) == (2, 3, 8, 5.0)
    # The price of a grasp is that of some frames, and that of a frame stays.
    assert (grasps.grasp, grasps.free) == (GraspStage().grasp / 2, GraspStage().free)
    assert next(s for s in plan.stages if isinstance(s, MoveStage)).loose_frames == 1


def test_few_frames_a_second_still_make_a_grasp() -> None:
    grasps = stage_at(3.0, GraspStage())
    assert isinstance(grasps, GraspStage)
    assert (grasps.least, grasps.gap, grasps.longest_move) == (2, 1, 2)
    # Who asks for less than that keeps it.
    grasps = stage_at(3.0, GraspStage(least=2, gap=0))
    assert isinstance(grasps, GraspStage) and (grasps.least, grasps.gap) == (2, 0)


def test_steps_from_frame_to_frame_may_be_longer() -> None:
    assert weight_at(15.0, "rigid") == weight_at(15.0, "smooth") == 0.5
    assert weight_at(15.0, "acceleration") == weight_at(15.0, "object_acceleration") == 0.125


def test_other_weights_stay() -> None:
    for before, after in zip(FAST.stages, at_rate(FAST, 15.0).stages, strict=True):
        if isinstance(before, OptimizeStage | MoveStage):
            assert isinstance(after, OptimizeStage | MoveStage)
            changed = {name for name in before.weights if before.weights[name] != after.weights[name]}
            assert changed == before.weights.keys() & {"acceleration", "object_acceleration", "rigid"}


@pytest.mark.parametrize("fps", [10.0, 15.0, 60.0])
def test_a_random_walk_of_velocity_costs_the_same_at_any_rate(fps: float) -> None:
    # Fine steps of a motion whose velocity wanders, looked at 60 and `fps` times a second.
    rng = np.random.default_rng(0)
    walk = 1e-5 * rng.standard_normal((60_000, 20, 3)).cumsum(0).cumsum(0)
    fine = 1200
    seen = {rate: torch.from_numpy(walk[:: int(fine / rate)]) for rate in (USUAL_FPS, fps)}
    costs = {
        rate: float(acceleration(points)) * weight_at(rate, "acceleration") for rate, points in seen.items()
    }
    assert costs[fps] == pytest.approx(costs[USUAL_FPS], rel=0.1)
    steps = torch.from_numpy(1e-4 * rng.standard_normal((60_000, 20, 3)).cumsum(0))
    shaken = {
        rate: float(velocity(points := steps[:: int(fine / rate)], torch.ones(len(points) - 1)))
        * weight_at(rate, "rigid")
        for rate in (USUAL_FPS, fps)
    }
    assert shaken[fps] == pytest.approx(shaken[USUAL_FPS], rel=0.1)


def test_the_tracker_expects_as_much_motion_in_a_second() -> None:
    """A motion's prior cost per frame is the same at half the rate: its changes are larger, and expected."""
    rng = np.random.default_rng(1)
    fine = 20
    turns = 1e-5 * rng.standard_normal((400 * fine, 3)).cumsum(0).cumsum(0)
    places = 2e-6 * rng.standard_normal((400 * fine, 3)).cumsum(0).cumsum(0) + [0.0, 0.0, 1.0]
    K = np.array([[500.0, 0, 200], [0, 500.0, 150], [0, 0, 1]])
    costs = {}
    for fps in (30.0, 15.0):
        step = int(30 / fps) * fine
        stage = stage_at(fps, next(s for s in FAST.stages if isinstance(s, ObjectMotionStage)))
        assert isinstance(stage, ObjectMotionStage)
        config = stage.tracker.map.bundle
        assert (config == BundleConfig()) == (fps == 30.0)
        frames = len(turns[::step])
        # One point in the middle of one picture, so that the prior is nearly all that costs.
        bundle = Bundle(
            Rotation.from_rotvec(turns[::step] - turns[0]).as_matrix(),
            places[::step],
            np.zeros((1, 3)),
            np.array([0]),
            np.array([0]),
            np.array([[200.0, 150.0]]),
            alike(1),
        )
        problem = make_problem(bundle, K, config, np.ones(frames, dtype=bool), None)
        costs[fps] = cost_of(problem, bundle) / (frames - 2)
    assert costs[15.0] == pytest.approx(costs[30.0], rel=0.15)
