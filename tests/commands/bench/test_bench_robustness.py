"""`bigs bench robustness`: what each damage does, what runs, and how scores stand beside clean ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Answer, assert_refused
from fake_runs import SCORES, FakeRuns
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from bigs.commands.bench import robustness as module
from bigs.commands.bench.clip_damage import DAMAGES, ClipDamage, write_damaged
from bigs.commands.bench.robustness import RobustnessPlan, bench_robustness
from bigs.commands.evaluate.runs import Evaluation, EvaluationPlan
from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.hand import HandModel
from bigs.types import MASK_VALUES, Side


@pytest.fixture
def damaged(tiny: Clip, both_hands: dict[Side, HandModel], tmp_path: Path) -> Callable[[ClipDamage], Clip]:
    return lambda damage: load_hold(write_damaged(tmp_path, tiny, both_hands, damage, seed=3))


def _turns(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Degrees between rotations [T, 3, 3]."""
    return np.degrees(Rotation.from_matrix(found @ true.transpose(0, 2, 1)).magnitude())


def test_no_damage_is_the_clip_itself(tiny: Clip, damaged: Callable[[ClipDamage], Clip]) -> None:
    found = damaged(ClipDamage("nothing"))
    np.testing.assert_allclose(found.K, tiny.K)
    for side, track in tiny.hands.items():
        np.testing.assert_allclose(found.hands[side].global_orient, track.global_orient, atol=1e-6)
        np.testing.assert_allclose(found.hands[side].transl, track.transl, atol=1e-6)
    np.testing.assert_allclose(found.object.points_world(), tiny.object.points_world(), atol=1e-5)
    for t in (0, 7):
        assert np.array_equal(found.image(t), tiny.image(t)) and np.array_equal(found.mask(t), tiny.mask(t))


def test_outlines_and_blobs_change_outlines_alone(tiny: Clip, damaged: Callable[[ClipDamage], Clip]) -> None:
    found = damaged(ClipDamage("", outline=3.0))
    inside = tiny.mask(4) == MASK_VALUES["object"]
    grown = found.mask(4) == MASK_VALUES["object"]
    changed = (inside != grown).sum() / inside.sum()
    assert 0.02 < changed < 0.6
    away = np.maximum(distance_transform_edt(inside), distance_transform_edt(~inside))
    assert away[inside != grown].max() <= 4.0
    found = damaged(ClipDamage("", blobs=2))
    assert (found.mask(4) != tiny.mask(4)).any()


def test_masks_are_lost_and_swapped_in_some_frames(tiny: Clip, damaged: Callable[[ClipDamage], Clip]) -> None:
    found = damaged(ClipDamage("", maskless=0.1, swapped=0.2))
    empty = np.array([not found.mask(t).any() for t in range(len(tiny))])
    assert empty.sum() == 2
    changed = [t for t in np.flatnonzero(~empty) if not np.array_equal(found.mask(t), tiny.mask(t))]
    assert 1 <= len(changed) <= 3
    for t in changed:
        right = tiny.mask(t) == MASK_VALUES["right"]
        assert np.array_equal(right, found.mask(t) == MASK_VALUES["left"])


def test_pictures_get_noise_artefacts_and_another_exposure(
    tiny: Clip, damaged: Callable[[ClipDamage], Clip]
) -> None:
    true = np.stack([tiny.image(t) for t in range(len(tiny))]).astype(float)

    def pictures(damage: ClipDamage) -> np.ndarray:
        found = damaged(damage)
        return np.stack([found.image(t) for t in range(len(tiny))]).astype(float)

    middle = (true > 40) & (true < 215)
    assert (pictures(ClipDamage("", noise=6.0)) - true)[middle].std() == pytest.approx(6.0, rel=0.05)
    assert 0.5 < np.abs(pictures(ClipDamage("", jpeg=60)) - true).mean() < 10.0
    gains = np.median(pictures(ClipDamage("", exposure=0.2)) / np.maximum(true, 1.0), axis=(1, 2, 3))
    assert gains.min() < 0.9 and gains.max() > 1.1 and (np.abs(gains - 1.0) < 0.21).all()


def test_dark_pictures_darken_the_points_of_the_object(
    tiny: Clip, damaged: Callable[[ClipDamage], Clip]
) -> None:
    found = damaged(ClipDamage("", brightness=0.3))
    for t in range(len(tiny)):
        assert np.abs(found.image(t) - 0.3 * tiny.image(t)).max() <= 0.51
    np.testing.assert_allclose(found.object.colors, 0.3 * tiny.object.colors, atol=0.01)


def test_gross_outliers_are_gross_and_few(tiny: Clip, damaged: Callable[[ClipDamage], Clip]) -> None:
    found = damaged(ClipDamage("", outliers=0.12))
    turned = _turns(found.object.rotations, tiny.object.rotations)
    assert (turned > 20.0).sum() == 2 and (turned > 0.1).sum() == 2
    moved = np.linalg.norm(found.object.points_world() - tiny.object.points_world(), axis=-1).mean(1)
    assert moved[turned > 20.0].max() < 0.25
    for side, track in tiny.hands.items():
        was, now = (Rotation.from_rotvec(t.global_orient).as_matrix() for t in (track, found.hands[side]))
        assert (_turns(now, was) > 20.0).sum() == 2


def test_a_longer_focal_length_moves_everything_away(
    tiny: Clip, damaged: Callable[[ClipDamage], Clip]
) -> None:
    found = damaged(ClipDamage("", focal=1.06))
    np.testing.assert_allclose(found.K[:2, :2], 1.06 * tiny.K[:2, :2])
    np.testing.assert_allclose(found.K[:, 2], tiny.K[:, 2])

    def depth(clip: Clip) -> np.ndarray:
        points = np.median(clip.object.points_world(), axis=1)
        return np.einsum("tj,tj->t", clip.cam_from_world[:, 2, :3], points) + clip.cam_from_world[:, 2, 3]

    np.testing.assert_allclose(depth(found), 1.06 * depth(tiny), rtol=0.003)


def test_runs_are_scored_on_the_clip_as_it_is(
    runs: FakeRuns, tiny_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[EvaluationPlan] = []

    def fake(run: Path, plan: EvaluationPlan, listen: object) -> Evaluation:
        asked.append(plan)
        worse = {"swapped": {"mpjpe_ra_r": 27.0}, "clean": {}}.get(run.name, {"cd_icp_sq": 0.75})
        return Evaluation("clip", {"result": SCORES | worse}, {}, (), {})

    monkeypatch.setattr(module, "evaluate_run", fake)
    runs.fail = "jpeg"
    plan = RobustnessPlan((tiny_clip,), ("swapped", "blobs", "jpeg"), "smoke")
    found = bench_robustness(plan, tmp_path)
    assert runs.made == ["clean", "swapped", "blobs", "jpeg"] and found.failed == ["clip: jpeg"]
    assert {plan.clip for plan in asked} == {tiny_clip}
    assert (tmp_path / "clip" / "clips" / "jpeg" / "build" / "data.npy").is_file()
    heading, clean, swapped, blobs = found.tables[0].rows
    assert swapped[heading.index("MPJPE mm")] == "27.00"
    assert (clean[-1], swapped[-1], blobs[-1]) == ("", "3.00", "1.50")
    rows = json.loads((tmp_path / "robustness.json").read_text())["runs"]
    assert [row["damage"] for row in rows] == ["clean", "swapped", "blobs", "jpeg"]
    assert (tmp_path / "robustness.md").read_text().count("##") == 2
    runs.fail, runs.made = None, []
    assert bench_robustness(plan, tmp_path).failed == [] and runs.made == ["jpeg"]


def test_what_the_command_line_refuses(call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert_refused(call("bench", "robustness", tiny_clip, "--damages", "rain", "--out", out), "rain")
    assert_refused(call("bench", "robustness", tiny_clip / "build" / "image", "--out", out))
    assert not out.exists()


def test_every_damage_alone_is_in_the_one_of_all() -> None:
    alone = {name: damage for name, damage in DAMAGES.items() if name != "together"}
    neutral = ClipDamage("")
    for damage in alone.values():
        for field in ("outline", "blobs", "maskless", "swapped", "noise", "jpeg", "exposure", "outliers"):
            value = getattr(damage, field)
            assert value in (getattr(neutral, field), getattr(DAMAGES["together"], field))
    assert DAMAGES["together"].focal == DAMAGES["focal"].focal != 1.0
