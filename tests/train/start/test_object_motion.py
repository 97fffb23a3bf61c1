"""The stage `object-motion`: what a run makes of tracks, keeps for its continuation, and does without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import bigs.train.start.object_motion as object_motion
from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.hand import HandModel
from bigs.motion.given_poses import GivenPoses
from bigs.motion.tracker import TrackedMotion
from bigs.motion.tracker_config import TrackerConfig
from bigs.train.check_plan import check_plan
from bigs.train.fit import fit
from bigs.train.plan.config import ObjectMotionStage, OptimizeStage, RunConfig
from bigs.train.plan.presets import FAST, PRESETS, SMOKE
from bigs.train.start.initial import object_in_camera
from bigs.train.start.object_motion import find_object_motion, pose_errors, with_motion
from bigs.train.switches import without
from bigs.types import Side

STAGE = ObjectMotionStage()


FOCAL = 0.95


def tracked(given: GivenPoses, turn: float = 2e-3) -> TrackedMotion:
    """The given poses a little aside, known well but for the last frame, through a shorter lens."""
    count = len(given.rotations)
    aside = axis_angle_to_matrix(torch.tensor([0.0, 0.01, 0.0], dtype=torch.float64)).numpy()
    covariance = np.tile(np.diag([turn**2] * 3 + [1e-8] * 3), (count, 1, 1))
    covariance[-1] *= 400.0
    return TrackedMotion(
        aside @ given.rotations,
        given.transl * [1.0, 1.0, FOCAL],
        covariance,
        np.full(count, 100),
        np.zeros(count, dtype=bool),
        np.zeros((0, 3)),
        np.zeros((0, 3), dtype=np.uint8),
        np.zeros((0, 2), dtype=int),
        0.02,
        np.full(3, 0.003),
        FOCAL,
        0.01,
    )


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[GivenPoses]:
    """Every search for tracks, which finds at once what `tracked` says."""
    seen: list[GivenPoses] = []

    def track(
        images: object, masks: np.ndarray, K: np.ndarray, given: GivenPoses, config: object
    ) -> TrackedMotion:
        assert masks.any() and masks.dtype == bool
        seen.append(given)
        return tracked(given)

    monkeypatch.setattr(object_motion, "track", track)
    return seen


def test_what_was_found_is_kept_for_the_same_clip_and_plan(
    tiny: Clip, calls: list[GivenPoses], tmp_path: Path
) -> None:
    first = find_object_motion(tiny, SMOKE.initial, STAGE, tmp_path)
    again = find_object_motion(tiny, SMOKE.initial, STAGE, tmp_path)
    assert len(calls) == 1
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one, other)
    other_stage = replace(STAGE, tracker=replace(STAGE.tracker, overlap=3))
    find_object_motion(tiny, SMOKE.initial, other_stage, tmp_path)
    assert len(calls) == 2
    # A file that was cut short counts for nothing.
    file = tmp_path / object_motion.FILE_NAME
    file.write_bytes(file.read_bytes()[:500])
    find_object_motion(tiny, SMOKE.initial, other_stage, tmp_path)
    assert len(calls) == 3


def test_tracks_are_sought_in_the_pictures_as_they_were_taken(
    tiny: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[np.ndarray] = []

    def track(
        images: list[np.ndarray], masks: object, K: object, given: GivenPoses, config: object
    ) -> TrackedMotion:
        seen.extend(images)
        return tracked(given)

    monkeypatch.setattr(object_motion, "track", track)
    find_object_motion(replace(tiny, gains=np.full((len(tiny), 3), 2.0)), SMOKE.initial, STAGE, None)
    assert len(seen) == len(tiny)
    for t, image in enumerate(seen):
        np.testing.assert_array_equal(image, tiny.image(t))


@pytest.mark.parametrize(
    ("wavers", "given", "automatic", "believed"),
    [
        (False, 0.8, 0.5, 0.8),
        (True, 0.8, 0.5, 0.5),
        (True, 0.8, 0.2, 0.2),
        (True, 0.3, 0.5, 0.3),
        (True, 1.0, 0.5, 1.0),
    ],
)
def test_a_camera_that_sets_its_own_exposure_is_rarely_calibrated(
    tiny: Clip,
    monkeypatch: pytest.MonkeyPatch,
    wavers: bool,
    given: float,
    automatic: float,
    believed: float,
) -> None:
    """Unless the user says that it is, by `--without focal` for one."""
    seen: list[float] = []

    def track(
        images: object, masks: object, K: object, poses: GivenPoses, config: TrackerConfig
    ) -> TrackedMotion:
        seen.append(config.focal.calibrated)
        return tracked(poses)

    monkeypatch.setattr(object_motion, "track", track)
    clip = replace(tiny, gains=np.full((len(tiny), 3), 1.1, dtype=np.float32)) if wavers else tiny
    tracker = replace(STAGE.tracker, focal=replace(STAGE.tracker.focal, calibrated=given))
    stage = ObjectMotionStage(tracker=tracker, calibrated_automatic=automatic)
    find_object_motion(clip, SMOKE.initial, stage, None)
    assert seen == [believed]


def test_a_clip_without_an_object_has_no_motion(tiny: Clip, calls: list[GivenPoses]) -> None:
    assert find_object_motion(replace(tiny, object=None), SMOKE.initial, STAGE, None) is None
    hidden = replace(tiny, mask_areas=tiny.mask_areas | {"object": np.zeros(len(tiny), dtype=int)})
    assert find_object_motion(hidden, SMOKE.initial, STAGE, None) is None
    assert not calls


def test_the_start_takes_the_motion_and_its_certainty(tiny: Clip, calls: list[GivenPoses]) -> None:
    motion = find_object_motion(tiny, SMOKE.initial, STAGE, None)
    before = object_in_camera(tiny, SMOKE.initial)
    after = with_motion(before, motion)
    torch.testing.assert_close(after.rotations, torch.as_tensor(motion.rotations, dtype=torch.float32))
    assert after.trust[:-1].eq(1.0).all() and after.trust[-1] == before.trust[-1]
    errors = pose_errors(motion)
    torch.testing.assert_close(errors.turn[0], 2e-3 * torch.eye(3))
    torch.testing.assert_close(errors.turn[-1], 4e-2 * torch.eye(3))


def test_a_run_that_goes_on_ends_in_the_same_bytes(
    tiny: Clip, both_hands: dict[Side, HandModel], calls: list[GivenPoses], tmp_path: Path
) -> None:
    joint = next(stage for stage in SMOKE.stages if stage.name == "appearance")
    joint = replace(joint, steps=4, lrs={**joint.lrs, "object.orient": 1e-3, "object.ray": 1e-3})
    stages = (STAGE, joint)
    config = replace(SMOKE, stages=stages, checkpoint_every=2)

    def stop(event: dict) -> None:
        if event["event"] == "step" and event["step"] == 3:
            raise KeyboardInterrupt

    whole, report = fit(tiny, both_hands, config, checkpoints=tmp_path / "whole")
    assert "object motion" in report.facts and "object-motion" in report.seconds
    with pytest.raises(KeyboardInterrupt):
        fit(tiny, both_hands, config, checkpoints=tmp_path / "cut", listen=stop)
    fit(tiny, both_hands, config, checkpoints=tmp_path / "cut", resume=True)
    assert len(calls) == 2  # the continuation reads what its first part found
    saved = [load_file(tmp_path / name / "latest.safetensors") for name in ("whole", "cut")]
    assert saved[0].keys() == saved[1].keys()
    assert all(saved[0][key].equal(saved[1][key]) for key in saved[0])
    # Poses that are known well have hardly left their start; the last one was free to.
    turns = whole.object_poses.turn_freedom @ whole.object_poses.orient.detach()[..., None]
    assert turns[:-1].norm(dim=1).max() < 0.1 * 4 * 1e-3
    assert whole.object_poses.turn_freedom[-1].allclose(torch.eye(3))


def test_a_run_goes_on_with_the_focal_length_of_the_tracks(
    tiny: Clip, both_hands: dict[Side, HandModel], calls: list[GivenPoses]
) -> None:
    """The hands come nearer as the object does, and stay where they are seen."""
    scenes = [fit(tiny, both_hands, replace(SMOKE, stages=stages))[0] for stages in ((), (STAGE,))]
    lens = torch.tensor([[FOCAL], [FOCAL], [1.0]]) * torch.eye(3) + (1 - torch.eye(3))
    torch.testing.assert_close(scenes[1].K, lens * scenes[0].K)
    frames = torch.arange(len(tiny))
    for side in scenes[0].hand_poses:
        before, after = (scene.hand_poses[side](frames).wrist for scene in scenes)
        torch.testing.assert_close(after[:, 2], FOCAL * before[:, 2])
        torch.testing.assert_close(after[:, :2], before[:, :2])


def test_it_can_be_left_out_and_stands_first_where_it_is() -> None:
    for name in ("fast", "full"):
        assert isinstance(PRESETS[name].stages[0], ObjectMotionStage)
        less = without(PRESETS[name], "object-motion")
        assert less.stages == PRESETS[name].stages[1:]
    late: RunConfig = replace(FAST, stages=(*FAST.stages[1:3], STAGE))
    assert isinstance(late.stages[0], OptimizeStage)
    with pytest.raises(InputError, match="expected this stage first"):
        check_plan(late)
