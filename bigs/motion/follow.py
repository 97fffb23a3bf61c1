"""Features followed from each frame to the next by their patch, where descriptors find too little.

A side that the object shows edge-on or that is nearly plain has few features that are found in two pictures.
What was found in one can still be followed into the next, since little changes between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.spatial

from bigs.motion.features import FrameFeatures
from bigs.motion.patches import Laid, PatchConfig, Pictures, cut_templates, lay


@dataclass(frozen=True)
class FollowConfig:
    """How features are followed; lengths in pixels of the clip's images."""

    # Neighbours with this many matches are not followed.
    enough: int = 250
    # Reductions of the picture, from coarse to fine.
    levels: tuple[int, ...] = (4, 2, 1)
    # Pixels of a patch on each side of its middle. In blurred and pale pictures 4 was too few.
    half: int = 6
    iterations: int = 6
    likeness: float = 0.85
    # A feature that is followed there and back must return this near to its start.
    there_and_back: float = 0.2
    # Standard deviation of its position along the direction in which its patch says least.
    most_unsure: float = 0.2
    # Number of nearby matches that predict where a feature goes.
    guides: int = 5
    # A result this near to a feature of the other frame is that feature.
    same: float = 0.7
    # Number of features that are followed from each frame, and their spacing.
    most: int = 500
    apart: float = 2.0


Matches = dict[tuple[int, int], np.ndarray]  # of two frames: which of their features [n, 2] go together


def follow(
    features: Sequence[FrameFeatures],
    matches: Mapping[tuple[int, int], np.ndarray],
    images: Sequence[np.ndarray],
    masks: np.ndarray,
    config: FollowConfig,
) -> tuple[list[FrameFeatures], Matches]:
    """Features and matches with what following adds: later features come after those that were there.

    Args:
        features: of T frames.
        matches: verified ones of pairs of frames.
        images: T arrays [H, W, 3] uint8.
        masks: [T, H, W] bool, the object.
        config: see there.
    """
    patch = PatchConfig(
        half=config.half,
        iterations=config.iterations,
        likeness=config.likeness,
        most_moved=np.inf,
        most_unsure=config.most_unsure,
    )
    levels = [Pictures(images, masks, patch, coarser) for coarser in config.levels]
    features, united = list(features), dict(matches)
    # Features that were followed from an earlier frame are continued first.
    reached = np.zeros(0, dtype=int)
    for t in range(len(features) - 1):
        here, there = features[t], features[t + 1]
        known = matches.get((t, t + 1), np.zeros((0, 2), dtype=int))
        if len(known) >= config.enough:
            reached = known[:, 1]
            continue
        chosen = _chosen(here, reached, known[:, 0], config)
        start = here.pixels[chosen]
        guess = start + _guided(start, here.pixels[known[:, 0]], there.pixels[known[:, 1]], config)
        laid = _followed(levels, (t, t + 1), start, guess, patch)
        back = _followed(levels, (t + 1, t), laid.pixels, laid.pixels + start - guess, patch)
        fits = laid.fits & _on(masks[t + 1], laid.pixels)
        fits &= back.fits & (np.linalg.norm(back.pixels - start, axis=1) < config.there_and_back)
        pairs, features[t + 1] = _landed(there, known[:, 1], here, chosen[fits], laid.pixels[fits], config)
        united[t, t + 1] = np.concatenate([known, pairs])
        reached = united[t, t + 1][:, 1]
    return features, united


def _chosen(
    here: FrameFeatures, reached: np.ndarray, matched: np.ndarray, config: FollowConfig
) -> np.ndarray:
    """Which features to follow: `reached` ones first, none that is `matched` already or near another."""
    order = np.concatenate([reached, np.setdiff1d(np.arange(len(here.pixels)), reached)])
    if len(order) == 0:
        return order
    # Each feature is its own neighbour too.
    near = scipy.spatial.cKDTree(here.pixels).query_ball_point(here.pixels, config.apart)
    blocked = np.zeros(len(here.pixels), dtype=bool)
    for i in matched:
        blocked[near[i]] = True
    chosen: list[int] = []
    for i in order:
        if not blocked[i] and len(chosen) < config.most:
            chosen.append(i)
            blocked[near[i]] = True
    return np.array(chosen, dtype=int)


def _guided(start: np.ndarray, before: np.ndarray, after: np.ndarray, config: FollowConfig) -> np.ndarray:
    """How far [n, 2] features at pixels `start` go at first: as matches near do, `before` to `after`."""
    if len(before) < config.guides or len(start) == 0:
        return np.zeros_like(start)
    nearest = scipy.spatial.cKDTree(before).query(start, k=config.guides)[1]
    return np.median((after - before)[nearest], axis=1)


def _followed(
    levels: Sequence[Pictures],
    frames: tuple[int, int],
    start: np.ndarray,
    guess: np.ndarray,
    patch: PatchConfig,
) -> Laid:
    """Patches about pixels `start` [n, 2] of the first frame, from pixels `guess` on in the second."""
    warp = np.tile(np.eye(2), (len(start), 1, 1))
    own = np.full(len(start), frames[0])
    for pictures in levels:
        templates = cut_templates(pictures, own, start, patch)
        laid = lay(pictures, frames[1], guess, warp, templates, patch)
        guess = laid.pixels
    return laid


def _on(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    column, row = np.floor(pixels).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    inside[inside] = mask[row[inside], column[inside]]
    return inside


def _landed(
    there: FrameFeatures,
    matched: np.ndarray,
    here: FrameFeatures,
    chosen: np.ndarray,
    landed: np.ndarray,
    config: FollowConfig,
) -> tuple[np.ndarray, FrameFeatures]:
    """Pairs [n, 2] of features, and the later frame's features with those that were not there.

    `there` are its own, of which `matched` are taken; features `chosen` [n] of `here` have landed at pixels
    `landed` [n, 2].
    """
    free = np.setdiff1d(np.arange(len(there.pixels)), matched)
    partner = np.full(len(landed), -1)
    if len(free) and len(landed):
        distance, nearest = scipy.spatial.cKDTree(there.pixels[free]).query(landed)
        order = np.argsort(distance, kind="stable")
        order = order[distance[order] < config.same]
        _, first = np.unique(nearest[order], return_index=True)
        partner[order[first]] = free[nearest[order[first]]]
    new = partner < 0
    partner[new] = len(there.pixels) + np.arange(int(new.sum()))
    source = chosen[new]
    added = FrameFeatures(
        np.concatenate([there.pixels, landed[new]]),
        np.concatenate([there.sizes, here.sizes[source]]),
        np.concatenate([there.angles, here.angles[source]]),
        np.concatenate([there.descriptors, here.descriptors[source]]),
    )
    return np.stack([chosen, partner], axis=1), added
