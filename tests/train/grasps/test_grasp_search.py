"""Cutting a clip into grasps: against every cut of a short one, and what faulty frames may do."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from bigs.train.grasps.find import _hypotheses
from bigs.train.grasps.search import (
    Prices,
    Stretch,
    certainties,
    grasps_by_estimates,
    grasps_by_frames,
    joined,
    still_costs,
    stray_frames,
)

PRICES = Prices(free=3.0, grasp=8.0, least=4, gap=5)
SIGMA = 0.005


def seen(x: np.ndarray, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A hand of four points whose place moves along one axis, metres, seen along z where it is uncertain."""
    rng = np.random.default_rng(2)
    points = 0.05 * rng.standard_normal((1, 4, 3)) + x[:, None, None] * np.array([1.0, 0.0, 0.0])
    points += noise * rng.standard_normal((len(x), 1, 3)) * np.array([1.0, 1.0, 4.0])
    information = np.tile(np.diag([1.0, 1.0, 1.0 / 16.0]) / SIGMA**2, (len(x), 1, 1))
    return points, information


def places(*stretches: tuple[int, float]) -> np.ndarray:
    """Still for some frames at each place, with 8 frames between them."""
    parts = [np.full(stretches[0][0], stretches[0][1])]
    for (_, a), (count, b) in pairwise(stretches):
        parts += [np.linspace(a, b, 10)[1:-1] + 0.06 * np.sin(np.linspace(0, np.pi, 8)), np.full(count, b)]
    return np.concatenate(parts)


def test_costs_of_stretches_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((7, 3, 3))
    roots = rng.standard_normal((7, 3, 3))
    information = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3)
    costs = still_costs(points, information)
    for a, b in ((0, 7), (2, 5), (3, 4)):
        total = 0.0
        for k in range(3):
            place = np.linalg.solve(
                information[a:b].sum(0), np.einsum("tij,tj->i", information[a:b], points[a:b, k])
            )
            off = points[a:b, k] - place
            total += np.einsum("ti,tij,tj->", off, information[a:b], off)
        assert costs[a, b] == pytest.approx(total / 9, abs=1e-9)
    assert np.isinf(costs[3, :4]).all()


def own_ends(row: np.ndarray, start: int, stop: int, free: float) -> int:
    """How many ends a grasp has within the clip, by what its frames cost [T]; the border is none where it is
    sure."""
    return sum(
        bool(own) for own in (start > 0 or row[0] > 0.5 * free, stop < len(row) or row[-1] > 0.5 * free)
    )


def price_of(row: np.ndarray, start: int, stop: int, prices: Prices, each: float | None = None) -> float:
    """Of a stretch, a grasp or of the price `each`; infinite where it is too short."""
    ends = own_ends(row, start, stop, prices.free)
    reaches = (start == 0 and row[0] <= 0.5 * prices.free) or (
        stop == len(row) and row[-1] <= 0.5 * prices.free
    )
    least = prices.least_at_border if reaches else prices.least
    each = prices.grasp if each is None else each
    return row[start:stop].sum() + 0.5 * each * ends if stop - start >= least else np.inf


def cheapest_of_all(costs: np.ndarray, prices: Prices, resting: np.ndarray | None = None) -> float:
    """The least price of any cut, by trying every one."""
    count = costs.shape[1]
    rests = np.empty((0, count)) if resting is None else resting
    best = prices.free * count
    edges = range(count + 1)
    for grasps in range(1, 4):
        for cut in combinations(edges, 2 * grasps):
            pairs = list(zip(cut[::2], cut[1::2], strict=True))
            near = any(after[0] - before[1] < prices.gap for before, after in pairwise(pairs))
            if near:
                continue
            inside = 0.0
            for a, b in pairs:
                held = [price_of(row, a, b, prices) for row in costs]
                inside += min(held + [price_of(row, a, b, prices, 0.5 * prices.grasp) for row in rests])
            held = sum(b - a for a, b in pairs)
            best = min(best, inside + prices.free * (count - held))
    return best


@pytest.mark.parametrize("seed", range(6))
def test_no_cut_is_cheaper(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.gamma(0.7, 1.5, (2, 13))
    prices = Prices(free=1.0, grasp=0.4, least=4, gap=2)
    found = grasps_by_frames(costs, prices)
    limited = np.minimum(costs, 2.5)
    held = sum(len(frames) for frames, _ in found)
    paid = sum(price_of(limited[h], s.start, s.stop, prices) for s, h in found) + 13 - held
    assert paid == pytest.approx(cheapest_of_all(limited, prices))
    assert all(b.frames.start - a.frames.stop >= 2 for a, b in pairwise(found))


@pytest.mark.parametrize("seed", range(6))
def test_no_cut_with_hands_that_rest_is_cheaper(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs, resting = rng.gamma(0.7, 1.5, (2, 2, 13))
    # One grasp fits perfectly, so that it is found beside what rests.
    costs[0, :5] = 0.0
    prices = Prices(free=1.0, grasp=0.4, least=4, gap=2)
    least = cheapest_of_all(np.minimum(costs, 2.5), prices, np.minimum(resting, 2.5))
    found = grasps_by_frames(costs, prices, resting)
    # The grasps as found, and whatever else is cheapest beside them, cost no more than the best cut.
    held = np.minimum(costs, 2.5)
    only = np.full_like(held, 100.0)
    for frames, hypothesis in found:
        only[hypothesis, frames] = held[hypothesis, frames]
    assert cheapest_of_all(only, prices, np.minimum(resting, 2.5)) == pytest.approx(least)
    assert found and found[0].frames.start == 0


def test_a_hand_that_rests_beside_an_object_at_rest_holds_nothing() -> None:
    costs = np.full((2, 40), 9.0)
    costs[0, :12], costs[1, 20:] = 0.1, 0.1
    resting = np.full((1, 40), 9.0)
    assert [s.frames for s in grasps_by_frames(costs, PRICES, resting)] == [range(0, 12), range(20, 40)]
    resting[0, :12] = 0.1
    assert grasps_by_frames(costs, PRICES, resting) == [(range(20, 40), 1)]


def test_a_rest_within_a_grasp_is_a_part_of_it() -> None:
    costs, resting = np.full((1, 40), 0.3), np.full((1, 40), 9.0)
    resting[0, 10:30] = 0.1
    assert grasps_by_frames(costs, PRICES, resting) == [(range(0, 40), 0)]


def test_a_clip_in_which_nothing_moves_is_one_grasp() -> None:
    still = np.full((1, 40), 0.3)
    assert grasps_by_frames(still, PRICES, still) == [(range(0, 40), 0)]


def test_grasps_are_found_where_the_hand_stands_still() -> None:
    points, information = seen(places((12, 0.0), (5, 0.05), (15, 0.02)), noise=0.001)
    found = grasps_by_estimates(points, information, np.ones(len(points), bool), PRICES)
    assert len(found) == 3, "five frames are enough"
    for frames, (start, stop) in zip(found, ((0, 12), (20, 25), (33, 48)), strict=True):
        assert abs(frames.start - start) <= 2 and abs(frames.stop - stop) <= 2


@pytest.mark.parametrize(("count", "held"), [(1, False), (2, False), (3, True)])
def test_the_border_may_cut_a_grasp_short(count: int, held: bool) -> None:
    """It goes on beyond the clip, so three frames are enough there, and not between two moves."""
    move = np.linspace(0.0, 0.8, 10)[1:-1]
    x = np.concatenate([np.zeros(count), move, np.full(3, 0.8), 0.8 + move, np.full(15, 1.6)])
    points, information = seen(x, noise=0.001)
    for order in (slice(None), slice(None, None, -1)):
        found = grasps_by_estimates(points[order], information[order], np.ones(len(points), bool), PRICES)
        if order.step:
            found = [range(len(points) - s.stop, len(points) - s.start) for s in found[::-1]]
        assert found == [range(0, 3)] * held + [range(len(x) - 15, len(x))]


def test_estimates_that_waver_along_the_view_are_one_grasp() -> None:
    t = np.arange(60)
    points, information = seen(np.zeros(60))
    points = points + 0.015 * np.sin(t / 5)[:, None, None] * np.array([0.0, 0.0, 1.0])
    whole = [range(0, 60)]
    assert grasps_by_estimates(points, information, np.ones(60, bool), PRICES) == whole
    across = points[..., [2, 1, 0]]
    assert grasps_by_estimates(across, information, np.ones(60, bool), PRICES) != whole


def test_gross_errors_end_no_grasp() -> None:
    points, information = seen(np.zeros(40), noise=0.001)
    points[[7, 20, 21, 33]] += np.array([0.2, -0.1, 0.3])
    assert np.flatnonzero(stray_frames(points, information)).tolist() == [7, 20, 21, 33]
    assert grasps_by_estimates(points, information, np.ones(40, bool), PRICES) == [range(0, 40)]


def test_a_hand_that_never_touches_holds_nothing() -> None:
    points, information = seen(np.zeros(30))
    assert grasps_by_estimates(points, information, np.zeros(30, bool), PRICES) == []
    seldom = np.ones(30, bool)
    seldom[13:16] = False
    assert grasps_by_estimates(points, information, seldom, PRICES) == [range(0, 30)]


def test_hypotheses_compete_for_frames() -> None:
    costs = np.full((3, 40), 3.0)
    costs[0, :18], costs[1, 5:9], costs[2, 26:] = 0.1, 0.05, 0.1
    costs[0, 10:12] = 5.0
    found = grasps_by_frames(costs, Prices(1.0, 2.0, 4, 5))
    assert found == [(range(0, 18), 0), (range(26, 40), 2)], "two faulty frames are bridged"
    assert grasps_by_frames(np.zeros((0, 40)), PRICES) == []


def test_a_grasp_that_no_picture_shows_to_end_is_one() -> None:
    # Estimates had the hand in two ways: each hypothesis fits its own part, and the third fits everywhere.
    pictures = np.full((3, 40), 9.0)
    pictures[0, :15], pictures[1, 20:], pictures[2] = 0.2, 0.2, 0.7
    apart = [Stretch(range(0, 15), 0), Stretch(range(20, 40), 1)]
    assert joined(apart, pictures, PRICES) == [(range(0, 40), 2)]
    for change, why in (
        ((2, slice(17, 18), 1.6), "once between them the hand is seen elsewhere"),
        ((2, slice(0, 15), 2.4), "what fits between them does not fit the grasps"),
        ((slice(None), slice(15, 20), 3.0), "between them the hand does not touch"),
    ):
        changed = pictures.copy()
        changed[change[0], change[1]] = change[2]
        assert joined(apart, changed, PRICES) == apart, why
    # A faulty mask within a grasp says no more than that it is faulty.
    pictures[2], pictures[2, 30] = 0.4, 1e6
    assert joined(apart, pictures, PRICES) == [(range(0, 40), 2)]


def test_many_grasps_become_one_and_those_beside_them_stay() -> None:
    pictures = np.full((5, 60), 9.0)
    for hypothesis, start in enumerate((0, 12, 24, 45)):
        pictures[hypothesis, start : start + 7] = 0.1
    pictures[4, :31] = 0.3
    stretches = [Stretch(range(start, start + 7), h) for h, start in enumerate((0, 12, 24, 45))]
    assert joined(stretches, pictures, PRICES) == [(range(0, 31), 4), (range(45, 52), 3)]
    assert joined([], pictures, PRICES) == [] and joined(stretches[:1], pictures, PRICES) == stretches[:1]
    # Grasps may follow each other at once where no gap is asked for.
    close = [Stretch(range(0, 7), 0), Stretch(range(7, 12), 1)]
    assert joined(close, pictures, PRICES._replace(gap=0)) == [(range(0, 12), 4)]


@pytest.mark.parametrize(("last", "held"), [(0.3, True), (0.9, False)])
def test_a_doubtful_frame_at_the_border_is_no_grasp_that_goes_on(last: float, held: bool) -> None:
    costs = np.full((1, 30), 3.0)
    costs[0, 10:29], costs[0, 29] = 0.1, last
    prices = Prices(free=1.0, grasp=1.0, least=4, gap=5)
    (found,) = grasps_by_frames(costs, prices)
    # The frame costs less inside than outside, so the grasp has it; but then it pays for its end.
    assert found == (range(10, 30), 0)
    costs[0, 10:27], costs[0, 27:29] = 3.0, 0.1
    assert grasps_by_frames(costs, prices) == [(range(27, 30), 0)] * held


def test_what_the_border_cuts_off_is_a_hypothesis_of_its_own() -> None:
    for stretches in ([], [range(5, 20)]):
        found = _hypotheses(stretches, 30, PRICES)
        assert range(0, 3) in found and range(27, 30) in found
    assert all(0 <= h.start < h.stop <= 2 for h in _hypotheses([], 2, PRICES))


def test_certainty_is_even_where_a_frame_could_as_well_be_free() -> None:
    sure = certainties(np.array([0.0, 1.0, 2.0]), free=1.0)
    assert sure[0] > 0.98 and sure[1] == 0.5 and sure[2] < 0.02
