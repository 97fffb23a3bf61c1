"""Object size and hand depth from contact, against a generated clip whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from bigs.checks import InputError
from bigs.data.base import HandTrack
from bigs.data.formats.hold import load_hold
from bigs.data.synthetic import make_clip
from bigs.geometry.distance import DistanceField
from bigs.geometry.surface import DistanceGrid
from bigs.hand import HandModel, load_hand_models
from bigs.preprocess.align import AlignConfig, align, cheapest_path, contact_costs, posed_vertices
from bigs.preprocess.artefacts import ObjectSfm
from bigs.preprocess.object.rough_surface import SurfaceConfig, rough_surface, sights
from bigs.types import Side

FRAMES = 12
UNIT = 0.31  # metres per unit of the simulated structure from motion


@dataclass(frozen=True)
class Truth:
    hands: dict[Side, HandTrack]
    sfm: ObjectSfm
    masks: np.ndarray
    K: np.ndarray
    models: dict[Side, HandModel]


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    pytest.importorskip("embreex")
    models = load_hand_models(None)
    folder: Path = make_clip(
        tmp_path_factory.mktemp("align") / "clip", hand_models=models, frames=FRAMES, seed=4
    )
    clip = load_hold(folder)
    everywhere = np.ones(FRAMES, dtype=bool)
    with np.load(folder / "gt.npz") as gt:
        hands: dict[Side, HandTrack] = {}
        sides: tuple[Side, ...] = ("right", "left")
        for side in sides:
            pose = gt[f"{side}_pose"].reshape(FRAMES, 16, 3)
            hands[side] = HandTrack(
                pose[:, 0], pose[:, 1:], gt[f"{side}_trans"], gt[f"{side}_betas"], everywhere
            )
        rotations, transl = gt["obj_R"], gt["obj_t"]
    mesh = trimesh.load(folder / "gt_object.ply", process=False)
    points, _ = trimesh.sample.sample_surface_even(mesh, 1200, seed=0)
    sfm = ObjectSfm(
        rotations,
        transl / UNIT,
        everywhere,
        np.ones(FRAMES),
        np.asarray(points) / UNIT,
        np.zeros((len(points), 3), dtype=np.uint8),
        np.eye(4),
    )
    return Truth(hands, sfm, np.stack([clip.mask(t) for t in range(FRAMES)]), clip.K, models)


def pushed(truth: Truth, shares: np.ndarray) -> dict[Side, HandTrack]:
    """The hands, moved along their rays by `shares` [T] of their distance."""
    moved = {}
    for side, track in truth.hands.items():
        middle = posed_vertices(track, truth.models[side]).mean(1)
        moved[side] = replace(track, transl=track.transl + shares[:, None] * middle)
    return moved


def test_true_hands_give_the_true_size_and_stay(truth: Truth) -> None:
    found, report = align(truth.hands, truth.sfm, truth.masks, truth.K, truth.models, AlignConfig())
    assert found.scale == pytest.approx(UNIT, rel=0.03)
    assert all(touching.any() for touching in report.touching.values())
    for side, track in truth.hands.items():
        assert np.abs(found.hand_transl[side] - track.transl).max() < 0.05
    np.testing.assert_allclose(found.object_transl, found.scale * truth.sfm.transl)


def test_hands_at_wrong_depths_are_brought_to_the_object(truth: Truth) -> None:
    shares = 0.04 * np.cos(np.linspace(0.0, 3.1, FRAMES))
    hands = pushed(truth, shares)
    found, _ = align(hands, truth.sfm, truth.masks, truth.K, truth.models, AlignConfig())
    assert found.scale == pytest.approx(UNIT, rel=0.08)
    for side, track in truth.hands.items():
        # The same error of scale in hand and object is no error between them.
        size = found.scale / UNIT
        before = np.linalg.norm(hands[side].transl - track.transl, axis=1)
        after = np.linalg.norm(found.hand_transl[side] / size - track.transl, axis=1)
        assert after.mean() < 0.7 * before.mean()


def test_a_grip_that_a_hand_always_hides_may_be_there(truth: Truth) -> None:
    """No point was measured near a hand: the hands must not look for contact with what is left."""
    points = UNIT * truth.sfm.points
    hidden = np.zeros(len(points), dtype=bool)
    for side, track in truth.hands.items():
        verts = posed_vertices(track, truth.models[side])
        for t in range(FRAMES):
            own = (verts[t] - UNIT * truth.sfm.transl[t]) @ truth.sfm.rotations[t]
            hidden |= cKDTree(own).query(points)[0] < 0.025
    assert 0.2 < hidden.mean() < 0.8
    sfm = replace(truth.sfm, points=truth.sfm.points[~hidden], colors=truth.sfm.colors[~hidden])
    found, _ = align(truth.hands, sfm, truth.masks, truth.K, truth.models, AlignConfig())
    assert found.scale == pytest.approx(UNIT, rel=0.05)


def test_sizes_off_the_first_guess_cost_what_they_are_told_to(truth: Truth) -> None:
    costs = {}
    for prior in (0.0, 0.02):
        config = AlignConfig(size_prior=prior, finer=0)
        _, report = align(truth.hands, truth.sfm, truth.masks, truth.K, truth.models, config)
        costs[prior] = report.costs
    expected = 0.02 * (np.log(report.factors) / AlignConfig().size_sigma) ** 2
    np.testing.assert_allclose(costs[0.02] - costs[0.0], expected, atol=1e-9)


@pytest.mark.parametrize("possible", [0.001, 0.004])
def test_between_points_and_visual_hull_there_may_be_object(truth: Truth, possible: float) -> None:
    points = UNIT * truth.sfm.points
    config = SurfaceConfig(possible=possible)
    poses = (truth.sfm.rotations, UNIT * truth.sfm.transl)
    seen = sights(points, *poses, truth.sfm.confidence, truth.masks, truth.K, config)
    solid, outer = rough_surface(points[points[:, 2] > np.median(points[:, 2])], seen, config)
    known, met = solid.values.ravel(), outer.values.ravel()
    inside = seen.hull.distance(solid.points()) <= 0.0
    unknown = inside & (known > possible)
    assert unknown.sum() > 100
    np.testing.assert_allclose(met[unknown], possible)
    np.testing.assert_array_equal(met[inside & ~unknown], known[inside & ~unknown])
    assert (met <= known).all()


def test_hands_whose_depth_is_known_well_are_left_there(truth: Truth) -> None:
    """Contact moves those that an estimator places badly, and not those that it places well."""
    hands = pushed(truth, 0.04 * np.cos(np.linspace(0.0, 3.1, FRAMES)))
    moved = {}
    for sigma in (0.01, 0.04):
        config = AlignConfig(shift_sigma=sigma)
        found, _ = align(hands, truth.sfm, truth.masks, truth.K, truth.models, config)
        moved[sigma] = sum(np.abs(found.hand_transl[side] - hands[side].transl).mean() for side in hands)
    assert moved[0.01] < 0.6 * moved[0.04] and moved[0.04] > 0.004


def test_without_contact_the_object_is_put_at_the_hands_depth(truth: Truth) -> None:
    apart = np.where(truth.masks == 50, 0, truth.masks)
    apart[:, :4, :4] = 50
    apart[:, :8, :8][apart[:, :8, :8] != 50] = 0
    found, report = align(truth.hands, truth.sfm, apart, truth.K, truth.models, AlignConfig())
    assert found.scale == pytest.approx(UNIT, rel=0.15)
    assert "never touch" in report.notes[0]
    for side, track in truth.hands.items():
        assert np.array_equal(found.hand_transl[side], track.transl)


def test_without_hands_there_is_no_size(truth: Truth) -> None:
    with pytest.raises(InputError, match="at least one hand"):
        align({}, truth.sfm, truth.masks, truth.K, truth.models, AlignConfig())


def test_the_cheapest_path_is_the_cheapest_of_all() -> None:
    rng = np.random.default_rng(0)
    config = AlignConfig(shifts=4)
    costs = rng.random((4, 4))
    shares = np.linspace(-config.reach, config.reach, 4)

    def total(path: tuple[int, ...]) -> float:
        moved = np.diff(shares[list(path)])
        return float(
            sum(costs[t, s] for t, s in enumerate(path))
            + config.shift_weight * ((moved / config.change_sigma) ** 2).sum()
        )

    best = min(np.ndindex(4, 4, 4, 4), key=total)
    cost, path = cheapest_path(costs, config)
    assert tuple(path) == best and cost == pytest.approx(total(best))


def flat(height: float) -> DistanceField:
    """The half space below a height in metres, 10 cm to each side of the object's middle."""
    levels = np.linspace(-0.1, 0.1, 21)
    values = np.broadcast_to(levels - height, (21, 21, 21)).copy()
    return DistanceField(DistanceGrid(values, np.full(3, -0.1), 0.01))


@pytest.mark.parametrize(("height", "cost"), [(0.01, 0.5), (0.0, 0.0), (-0.01, 0.0), (-0.03, 1.4)])
def test_hands_touch_what_may_be_there_and_are_never_in_what_is(height: float, cost: float) -> None:
    """Above the outer surface they are too far; only below the solid one, 2 cm deeper, are they too deep."""
    config = AlignConfig(saturation=0.01, penetration=2.0, depth=0.003)
    hand = np.array([[[0.01 * x, 0.0, 0.5 + height] for x in range(-5, 5)]])
    poses = (np.eye(3)[None], np.array([[0.0, 0.0, 0.5]]))
    surfaces = (flat(0.0), flat(-0.02))
    costs, shifts = contact_costs(
        hand, np.array([[0.0, 0.0, 1.0]]), np.array([True]), poses, surfaces, 1.0, config
    )
    unmoved = np.abs(shifts[0]).argmin()
    assert shifts[0, unmoved] == pytest.approx(0.0, abs=1e-12)
    assert costs[0, unmoved] == pytest.approx(cost, abs=1e-3)
