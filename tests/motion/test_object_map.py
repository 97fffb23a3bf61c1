"""Tracks, seeds, growth and the truth-free checks, on exact scenes and on injected faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from turning_object import TurningObject, rotation_errors, turning_object

from bigs.motion.grow import GrowConfig, as_models_say, best_start, grow
from bigs.motion.object_map import ObjectMap
from bigs.motion.refine import RefineConfig, disagreement, polish, refine, smooth_parts, splices
from bigs.motion.seed import find_seed, smooth_runs
from bigs.motion.tracks import join_matches
from bigs.preprocess.object.checks import (
    FEW,
    LOOSE,
    OTHERWISE,
    REVERSED,
    TURN,
    CheckConfig,
    check_map,
    turn_cosines,
)

FLIP = np.diag([1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def egg() -> TurningObject:
    return turning_object()


def at_truth(egg: TurningObject) -> ObjectMap:
    found = egg.map()
    found.restart(np.arange(len(egg.rotations)), egg.rotations, egg.transl)
    return found


def test_matches_join_into_tracks() -> None:
    tracks = join_matches({(0, 1): np.array([[0, 2]]), (1, 2): np.array([[2, 1], [0, 0]])}, [2, 3, 2])
    found = {
        tuple(zip(tracks.frame[tracks.track == i], tracks.feature[tracks.track == i], strict=True))
        for i in range(tracks.total)
    }
    assert found == {((0, 0), (1, 2), (2, 1)), ((1, 0), (2, 0))}


def test_two_features_of_a_frame_are_not_one_point_and_near_frames_are_believed_first() -> None:
    matches = {(0, 2): np.array([[1, 0]]), (0, 1): np.array([[0, 0]]), (1, 2): np.array([[0, 0]])}
    tracks = join_matches(matches, [2, 1, 1])
    assert list(tracks.frame) == [0, 1, 2] and list(tracks.feature) == [0, 0, 0] and tracks.total == 1


def test_no_matches_give_no_tracks() -> None:
    assert join_matches({}, [3, 0]).total == 0


def test_a_kink_ends_a_run() -> None:
    turn = np.concatenate([np.full(6, 5.0), [40.0], np.full(9, 5.0)])
    rotations = Rotation.from_rotvec(np.radians(np.cumsum(turn))[:, None] * (0, 1, 0)).as_matrix()
    runs = smooth_runs(np.arange(16), rotations)
    assert list(runs[0]) == list(range(7, 16)) and list(runs[1]) == list(range(5))
    assert sorted(np.concatenate(runs)) == list(range(16))
    frames = np.concatenate([np.arange(10), np.arange(20, 26)])
    steady = Rotation.from_rotvec(np.radians(5.0 * frames)[:, None] * (0, 1, 0)).as_matrix()
    assert [list(run) for run in smooth_runs(frames, steady)] == [list(range(10)), list(range(10, 16))]


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_seed_is_the_image_that_perspective_allows(egg: TurningObject, mirrored: bool) -> None:
    seed = find_seed(egg.map(), egg.model(range(5, 25), mirrored))
    assert seed is not None
    assert seed.misfit < 0.7 * seed.mirror_misfit
    assert rotation_errors(seed.rotations, egg.rotations[seed.frames]).max() < 1.0


def test_growth_crosses_frames_that_show_next_to_nothing() -> None:
    egg = turning_object(hidden=(24, 25), shown_there=5, seed=1)
    found = egg.map()
    assert find_seed(found, egg.model(range(4, 22))) is not None
    grow(found, (), GrowConfig())
    polish(found, 2)
    errors = rotation_errors(found.rotations, egg.rotations)
    assert np.median(errors) < 0.5 and np.percentile(errors, 90) < 1.5
    assert np.bincount(found.frame[found.use()], minlength=40)[26:].min() > 50


def replayed(egg: TurningObject, order: np.ndarray) -> TurningObject:
    """The egg's frames in another order, each with noise of its own."""
    rng = np.random.default_rng(3)
    features = [
        egg.features[t]._replace(
            pixels=egg.features[t].pixels + 0.1 * rng.standard_normal(egg.features[t].pixels.shape)
        )
        for t in order
    ]
    return TurningObject(
        egg.rotations[order], egg.transl[order], egg.points, features, [egg.ids[t] for t in order]
    )


def test_growth_follows_a_motion_that_goes_back() -> None:
    """Where few points show, going on as before led to a map that turns on for ever."""
    order = np.concatenate([np.arange(24), np.arange(22, 2, -1)])
    egg = replayed(turning_object(points=120, noise=0.3, speed=9.0), order)
    found = egg.map()
    assert find_seed(found, egg.model(range(2, 14))) is not None
    grow(found, (), GrowConfig())
    polish(found, 2)
    assert rotation_errors(found.rotations, egg.rotations).max() < 2.0


@pytest.mark.parametrize("step", [1, -1])
def test_growth_knows_of_a_jump_by_a_partial_model(egg: TurningObject, step: int) -> None:
    """Whatever the model's frame and unit; and the start that the observations meet is taken."""
    found = at_truth(egg)
    t, last = 20, 20 - step
    (start,) = as_models_say(found, t, step, (egg.model(range(5, 35)), egg.model(range(20, 21))))
    assert np.allclose(start[0], egg.rotations[t], atol=1e-9)
    assert np.allclose(start[1], egg.transl[t], atol=2e-3)
    wrong = egg.rotations[last] @ Rotation.from_euler("y", 40.0, degrees=True).as_matrix()
    found.rotations[t], found.transl[t] = wrong, egg.transl[last]
    frames = np.arange(14, 27)
    starts = [(wrong, egg.transl[last]), start, (egg.rotations[last], egg.transl[last])]
    # With one step of adjustment not every start gets there.
    one_step = replace(found.config.bundle, pixel_sigma=2.0, iterations=1)
    assert best_start(found, t, frames, starts, one_step) is start


def test_of_starts_that_meet_as_many_observations_the_better_fit_is_taken(egg: TurningObject) -> None:
    """A narrow side that turned back at its widest fitted within the limit whichever way it was to go."""
    found = at_truth(egg)
    off = Rotation.from_euler("y", 0.4, degrees=True).as_matrix() @ egg.rotations[20]
    unmoved = replace(found.config.bundle, pixel_sigma=2.0, iterations=0)
    starts = [(off, egg.transl[20]), (egg.rotations[20], egg.transl[20])]
    rows = found.use() & (found.frame == 20)
    met = []
    for pose in starts:
        found.rotations[20], found.transl[20] = pose
        met.append(np.linalg.norm(found.reproject(rows) - found.pixels[rows], axis=1).max())
    assert max(met) < found.config.keep_error and met[0] > met[1]
    assert best_start(found, 20, np.arange(14, 27), starts, unmoved) is starts[1]


def test_the_search_finds_points_that_were_never_matched(egg: TurningObject) -> None:
    found = at_truth(egg)
    found.good[found.frame == 12] = False
    assert found.search(12) > 100
    new = found.use() & (found.frame == 12)
    errors = np.linalg.norm(found.reproject(new) - found.pixels[new], axis=1)
    assert np.percentile(errors, 90) < 1.0


def test_frames_without_a_known_point_are_left_where_they_are(egg: TurningObject) -> None:
    found = at_truth(egg)
    found.known[:] = False
    found.adjust(np.arange(5), np.ones(5, dtype=bool), found.config.bundle)
    assert np.array_equal(found.rotations[:5], egg.rotations[:5])


def test_nothing_is_flagged_where_nothing_is_wrong(egg: TurningObject) -> None:
    checks = check_map(at_truth(egg), egg.features, egg.tracks(), (), CheckConfig())
    assert not any(checks.flags)
    assert checks.mirror.min() > 5.0


def test_a_reversed_segment_is_flagged(egg: TurningObject) -> None:
    rotations = egg.rotations.copy()
    # From frame 20 on the mirror image, joined so that no single step is too long.
    join = egg.rotations[20]
    back = FLIP @ (egg.rotations[20:] @ join.T) @ FLIP @ join
    rotations[20:] = back
    found = egg.map()
    found.restart(np.arange(40), rotations, egg.transl)
    checks = check_map(found, egg.features, egg.tracks(), (), CheckConfig())
    assert all(REVERSED in words for words in checks.flags[25:])
    assert checks.doubtful()[25:].all()
    assert any(TURN in words for words in checks.flags[17:24])
    assert not any(REVERSED in words for words in checks.flags[:10])


def test_frames_that_see_nothing_and_what_hangs_behind_them_are_flagged() -> None:
    egg = turning_object(hidden=range(22, 29), seed=2)
    found = at_truth(egg)
    checks = check_map(found, egg.features, egg.tracks(), (), CheckConfig())
    assert all(FEW in checks.flags[t] for t in range(22, 29))
    assert not any(FEW in checks.flags[t] for t in range(20))
    assert all(LOOSE in words for words in checks.flags[22:29])


def bent(egg: TurningObject, since: int, degrees: float) -> np.ndarray:
    """The true rotations [T, 3, 3] with all from `since` on turned about the camera's axes."""
    angle = np.where(np.arange(len(egg.rotations)) >= since, np.radians(degrees), 0.0)
    return Rotation.from_rotvec(angle[:, None] * (0.3, 0.8, 0.5)).as_matrix() @ egg.rotations


def test_of_two_loosely_tied_parts_the_larger_is_believed() -> None:
    egg = turning_object(hidden=range(10, 21), seed=5)
    checks = check_map(at_truth(egg), egg.features, egg.tracks(), (), CheckConfig())
    flagged = np.array([LOOSE in words for words in checks.flags])
    assert flagged[:10].all() and not flagged[21:].any()


def test_a_partial_model_that_turns_otherwise_is_told() -> None:
    egg = turning_object(seed=6)
    model = egg.model(range(22, 40))
    degrees = disagreement(bent(egg, 36, 20.0), model)
    assert degrees[:14].max() < 5.0 and degrees[14:].min() > 12.0
    found = egg.map()
    found.restart(np.arange(40), bent(egg, 36, 20.0), egg.transl)
    checks = check_map(found, egg.features, egg.tracks(), (model,), CheckConfig())
    flagged = np.array([OTHERWISE in words for words in checks.flags])
    assert flagged[36:].all() and not flagged[:36].any()
    assert not smooth_parts([model._replace(points=model.points[:20])])


def test_what_a_model_says_before_a_kink_counts_as_what_it_says_after() -> None:
    """The model of a clip with a pause had all frames; growth had bent those before, and nothing told."""
    egg = turning_object(seed=6)
    rotations = egg.rotations.copy()
    rotations[15:] = rotations[15:] @ Rotation.from_rotvec([0.1, 0.4, 0.0]).as_matrix()
    model = egg.model(range(40))._replace(rotations=rotations)
    assert [list(part.frames) for part in smooth_parts([model])] == [list(range(16, 40)), list(range(14))]
    found = egg.map()
    turns = np.radians(np.clip(10 - np.arange(40), 0, 40) * 3.0)
    astray = Rotation.from_rotvec(turns[:, None] * (0.2, 0.9, 0.1)).as_matrix() @ egg.rotations
    found.restart(np.arange(40), astray, egg.transl)
    checks = check_map(found, egg.features, egg.tracks(), (model,), CheckConfig())
    flagged = np.array([OTHERWISE in words for words in checks.flags])
    assert flagged[:5].any() and not flagged[14:].any()
    spliced = list(splices(found, (model,), np.arange(20, 40), RefineConfig()))
    assert spliced and rotation_errors(spliced[0].rotations, egg.rotations).max() < 1.0


def test_a_partial_model_that_its_own_observations_contradict_says_nothing_against_the_map(
    egg: TurningObject,
) -> None:
    """Two short models of a can, 30 degrees off by themselves, flagged 28 of its right frames."""
    model = egg.model(range(20, 40))
    turns = np.radians(np.linspace(0.0, 25.0, 20))
    astray = Rotation.from_rotvec(turns[:, None] * (0.2, 0.9, 0.1)).as_matrix() @ model.rotations
    model = model._replace(rotations=astray)
    assert disagreement(egg.rotations, model).max() > 8.0
    checks = check_map(at_truth(egg), egg.features, egg.tracks(), (model,), CheckConfig())
    assert not any(checks.flags)


def test_a_partial_model_that_is_the_mirror_image_says_nothing_against_the_map(egg: TurningObject) -> None:
    model = egg.model(range(22, 40), mirrored=True)
    assert disagreement(egg.rotations, model).max() > 20.0
    checks = check_map(at_truth(egg), egg.features, egg.tracks(), (model,), CheckConfig())
    assert not any(checks.flags)


def test_a_bent_map_is_made_anew(egg: TurningObject) -> None:
    """Forgetting early mistakes is enough where frames see each other's points."""
    found = egg.map()
    found.restart(np.arange(40), bent(egg, 30, 3.0), egg.transl)
    assert rotation_errors(found.rotations, egg.rotations).max() > 2.0
    better, _ = refine(found, egg.tracks(), (), np.arange(10), RefineConfig())
    assert rotation_errors(better.rotations, egg.rotations).max() < 0.6


def test_a_partial_model_takes_the_place_of_a_bent_part(egg: TurningObject) -> None:
    """The map goes astray after frame 20; a model of the later frames was made without crossing to them."""
    found = egg.map()
    turns = np.radians(np.clip(np.arange(40) - 20, 0, 15) * 3.0)
    rotations = Rotation.from_rotvec(turns[:, None] * (0.2, 0.9, 0.1)).as_matrix() @ egg.rotations
    found.restart(np.arange(40), rotations, egg.transl)
    models = (egg.model(range(0, 15)), egg.model(range(19, 40)))
    offered = list(splices(found, models, np.arange(15), RefineConfig()))
    assert len(offered) == len(RefineConfig().depths)
    assert rotation_errors(rotations, egg.rotations).max() > 20.0
    assert rotation_errors(offered[0].rotations, egg.rotations).max() < 1.0
    misfits = []
    for pose in ((rotations, egg.transl), offered[0][1:]):
        found.restart(np.arange(40), *pose)
        found.settle()
        misfits.append(found.misfit())
    assert misfits[1] <= misfits[0]
    assert not list(splices(at_truth(egg), models, np.arange(15), RefineConfig()))


def test_a_partial_model_that_is_wrong_itself_takes_no_place(
    egg: TurningObject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It happened to fit a third of a percent better in a clip whose second model was reversed in depth."""
    models = (egg.model(range(0, 15)), egg.model(range(22, 40), mirrored=True))
    found = at_truth(egg)
    assert list(splices(found, models, np.arange(15), RefineConfig()))
    monkeypatch.setattr(
        ObjectMap, "misfit", lambda self: -rotation_errors(self.rotations, egg.rotations).max()
    )
    better, _ = refine(found, egg.tracks(), models, np.arange(15), RefineConfig())
    assert rotation_errors(better.rotations, egg.rotations).max() < 0.6


def test_a_turn_that_goes_back_is_a_warning_and_no_more() -> None:
    angle = np.concatenate([np.arange(15), np.arange(13, 0, -1)]) * 5.0
    rotations = Rotation.from_rotvec(np.radians(angle)[:, None] * (0, 1, 0)).as_matrix()
    cosine = turn_cosines(rotations)
    assert cosine[14] < 0.0 and cosine[:8].min() > 0.99
    still = np.tile(np.eye(3), (20, 1, 1))
    assert (turn_cosines(still) == 1.0).all()
