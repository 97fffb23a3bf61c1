"""Over which frames does a hand keep its place in the object's frame? Dynamic programs over the whole clip.

A hand that holds a rigid object stands still as seen from it; to take hold elsewhere it has to let go and
move. A clip is therefore cut into grasps and what lies between them, so that the whole costs least: what a
frame of a grasp costs says how badly it agrees with the rest of the grasp, every frame outside one costs the
same, and so does every grasp. No threshold on a speed decides, and a faulty frame costs no more than it can.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Largest price of a frame within a grasp, relative to one outside, so that a few wrong frames are bridged.
_MOST = 2.5
# A frame is an outlier if it is off by this many standard deviations from the median of its neighbours ...
_STRAY = 3.0
# ... within this many frames on either side, most of which agree.
_NEIGHBOURS = 3
# A frame agrees for sure with a grasp in which it costs no more than this, relative to one outside.
_SURE = 0.5
# Longer grasps are found in parts, which bounds the work for long clips.
_LONGEST = 400


class Stretch(NamedTuple):
    """One grasp: its frames, and which of several hypotheses it follows."""

    frames: range
    hypothesis: int


class Prices(NamedTuple):
    """The prices of a segmentation; frames of grasps pay by their misfit."""

    free: float  # price of a frame outside grasps
    grasp: float  # price of each grasp, half of it for each of its ends: the clip's border is none
    least: int  # fewest frames of a grasp
    gap: int  # fewest frames between two grasps: nobody lets go and grasps again in less

    @property
    def rest(self) -> float:
        """Price of a hand that rests, likewise; less, so that only a shared motion proves a grasp."""
        return 0.5 * self.grasp

    @property
    def least_at_border(self) -> int:
        """Fewest frames of a grasp that goes on beyond the clip: more than half of one."""
        return self.least // 2 + 1


def still_costs(points: np.ndarray, information: np.ndarray) -> np.ndarray:
    """How badly one still hand explains each stretch of frames.

    A hand's place errs more along the view than across it, and as the object turns so does the view in its
    frame: the best still hand is a weighted least-squares solution, and running sums give it for all
    stretches.

    Args:
        points: [T, K, 3] points of the hand in the object's frame, metres.
        information: [T, 3, 3] inverse covariance of a point's error in each frame, in the object's frame.

    Returns:
        [T, T + 1]: entry (a, b) is the squared error of frames a to b - 1, summed over frames and averaged
        over points and axes, about 1 a frame for a hand that stands still. Infinite where b <= a, and for
        stretches of more frames than any grasp may have.
    """
    count, points_count, _ = points.shape
    pulled = np.einsum("tij,tkj->tik", information, points)
    squares = np.einsum("tki,tik->t", points, pulled)
    sums = [
        np.concatenate([np.zeros((1, *v.shape[1:])), np.cumsum(v, axis=0)]) for v in (information, pulled)
    ]
    squares = np.concatenate([[0.0], np.cumsum(squares)])
    costs = np.full((count, count + 1), np.inf)
    for a in range(count):
        ends = np.arange(a + 1, min(count, a + _LONGEST) + 1)
        matrix, vector = (total[ends] - total[a] for total in sums)
        place = np.linalg.solve(matrix, vector)
        left = squares[ends] - squares[a] - np.einsum("uik,uik->u", place, vector)
        costs[a, ends] = np.maximum(left, 0.0) / (3 * points_count)
    return costs


def stray_frames(points: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Frames [T] (bool) that are far from where their neighbours, which agree, have the hand.

    For the arguments see `still_costs`.
    """
    count = len(points)
    stray = np.zeros(count, dtype=bool)
    for t in range(count):
        near = [s for s in range(max(0, t - _NEIGHBOURS), min(count, t + _NEIGHBOURS + 1)) if s != t]
        if not near:
            continue
        middle = np.median(points[near], axis=0)
        off = frame_errors(points[[t, *near]], information[[t, *near]], middle)
        stray[t] = off[0] > _STRAY**2 and np.median(off[1:]) < 1.0
    return stray


def frame_errors(points: np.ndarray, information: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Squared errors [T] of a still hand `place` [K, 3], averaged over points and axes; see `still_costs`."""
    off = points - place
    return np.einsum("tki,tij,tkj->t", off, information, off) / (3 * points.shape[1])


def grasps_by_estimates(
    points: np.ndarray, information: np.ndarray, touching: np.ndarray, prices: Prices
) -> list[range]:
    """Cut a clip into grasps by where the hand's estimates have it.

    Args:
        points, information: see `still_costs`.
        touching: [T] bool, whether the picture allows that the hand touches; a frame that does not is in a
            grasp never worth more than outside.
        prices: in squared standard deviations.
    """
    # An outlier says nothing about the place and pays as if it were outside.
    trust = np.where(stray_frames(points, information), 1e-3, 1.0)
    costs = still_costs(points, trust[:, None, None] * information)
    fixed = np.concatenate([[0.0], np.cumsum(prices.free * np.maximum(trust < 1.0, ~touching))])
    costs = (costs + fixed - fixed[:-1, None])[None]
    return [frames for frames, _ in _cheapest(costs, prices, np.array([prices.grasp]))]


def grasps_by_frames(costs: np.ndarray, prices: Prices, resting: np.ndarray | None = None) -> list[Stretch]:
    """Cut a clip into grasps, each of which follows one of H hypotheses.

    Args:
        costs: [H, T] what each frame pays under each hypothesis; limited to a few times `prices.free`.
        prices: in the same unit.
        resting: [R, T] the same for hands that rest, whatever the object does. Frames that one of them
            explains better are in no grasp.
    """
    if len(costs) == 0:
        return []
    every = costs if resting is None else np.concatenate([costs, resting])
    limited = np.minimum(every, _MOST * prices.free)
    sums = np.concatenate([np.zeros((len(every), 1)), np.cumsum(limited, axis=1)], axis=1)
    stretches = sums[:, None, :] - sums[:, :-1, None]
    each = np.where(np.arange(len(every)) < len(costs), prices.grasp, prices.rest)
    # The frames at a grasp's ends must be cheaper inside than outside.
    return [found for found in _cheapest(stretches, prices, each) if found.hypothesis < len(costs)]


def joined(stretches: list[Stretch], pictures: np.ndarray, prices: Prices) -> list[Stretch]:
    """The grasps, with those as one between which pictures show no letting go.

    Estimators err alike for many frames, so that a hand may seem to hold the object in two ways, one after
    the other. But whoever changes a grasp is seen to leave the object. If one hand that the object carries
    fits the masks in both grasps and in each frame between them, it is one grasp.

    Args:
        stretches: in order.
        pictures: [H, T] what each frame pays under each hypothesis, as far as pictures tell.
        prices: in the same unit.
    """
    pictures = np.minimum(pictures, _MOST * prices.free)
    found: list[Stretch] = []
    for stretch in stretches:
        found.append(stretch)
        if len(found) < 2:
            continue
        before, after = found[-2:]
        whole = range(before.frames.start, after.frames.stop)
        between = range(before.frames.stop, after.frames.start)
        together = pictures[:, whole].sum(axis=1)
        together[pictures[:, between].max(axis=1, initial=-np.inf) > _SURE * prices.free] = np.inf
        apart = sum(pictures[hypothesis, frames].sum() for frames, hypothesis in (before, after))
        if together.min() < apart + prices.free * len(between) + prices.grasp:
            found[-2:] = [Stretch(whole, int(together.argmin()))]
    return found


def _cheapest(costs: np.ndarray, prices: Prices, each: np.ndarray) -> list[Stretch]:
    """The cheapest cut, given what every stretch costs under every hypothesis: [H, T, T + 1].

    Args:
        costs: without the price of a stretch.
        prices: the other prices.
        each: [H] the price of a stretch under each hypothesis, half of it for each of its ends.
    """
    count = costs.shape[1]
    costs = _priced(costs, prices, each)
    which = costs.argmin(axis=0)
    cost = np.take_along_axis(costs, which[None], axis=0)[0]
    # The cheapest cut of the first t frames that may begin a grasp next, and the cheapest that ends in one.
    open_, ended = np.full(count + 1, np.inf), np.full(count + 1, np.inf)
    open_[0] = 0.0
    began = np.zeros(count + 1, dtype=int)
    after_grasp = np.zeros(count + 1, dtype=bool)
    for t in range(1, count + 1):
        candidates = open_[:t] + cost[:t, t]
        began[t] = candidates.argmin()
        ended[t] = candidates[began[t]]
        open_[t] = open_[t - 1] + prices.free
        if t >= prices.gap and ended[t - prices.gap] + prices.gap * prices.free < open_[t]:
            open_[t], after_grasp[t] = ended[t - prices.gap] + prices.gap * prices.free, True
    # The clip may end within a gap.
    tails = [(ended[count - n] + n * prices.free, count - n) for n in range(min(prices.gap, count) + 1)]
    least, last = min(tails)
    found: list[Stretch] = []
    t, in_grasp = (last, True) if least < open_[count] else (count, False)
    while t > 0:
        if in_grasp:
            found.append(Stretch(range(int(began[t]), t), int(which[began[t], t])))
            t, in_grasp = int(began[t]), False
        elif after_grasp[t]:
            t, in_grasp = t - prices.gap, True
        else:
            t -= 1
    return found[::-1]


def _priced(costs: np.ndarray, prices: Prices, each: np.ndarray) -> np.ndarray:
    """What every stretch costs with its ends; infinite where it is too short: [H, T, T + 1].

    The clip's border is no end where the frame there agrees. One that hardly does is no reason to believe
    that the grasp goes on.
    """
    count = costs.shape[1]
    sure = _SURE * prices.free
    came, goes = costs[:, 0, 1] <= sure, costs[:, -1, -1] <= sure
    costs = costs + each[:, None, None]
    costs[came, 0] -= 0.5 * each[came, None]
    costs[goes, :, -1] -= 0.5 * each[goes, None]
    lengths = np.arange(count + 1)[None] - np.arange(count)[:, None]
    allowed = np.tile(lengths >= prices.least, (len(costs), 1, 1))
    allowed[came, 0] = lengths[0] >= prices.least_at_border
    allowed[goes, :, -1] = lengths[:, -1] >= prices.least_at_border
    costs[~allowed] = np.inf
    return costs


def certainties(costs: np.ndarray, free: float) -> np.ndarray:
    """Certainty that a frame belongs to its grasp, from its cost there and outside, both as energies.

    Args:
        costs: [...] of frames in their grasps.
        free: the cost outside, which is an even chance.

    Returns:
        [...] in (0, 1), nearly 1 for a frame that fits perfectly.
    """
    return 1.0 / (1.0 + np.exp(4.0 * (costs / free - 1.0)))
