"""Feature tracks: matches of pairs of frames joined into the observations of one point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Tracks(NamedTuple):
    """Observations, sorted by frame; a track has at most one in a frame."""

    frame: np.ndarray  # [M]
    feature: np.ndarray  # [M] which of the frame's features
    track: np.ndarray  # [M]
    total: int  # number of tracks


def join_matches(matches: Mapping[tuple[int, int], np.ndarray], counts: Sequence[int]) -> Tracks:
    """Observations joined along matches, those of near frames first.

    A match that would bring two features of a frame into one track is wrong, or one of the matches before it
    was; it is left out.

    Args:
        matches: of pairs of frames, each [n, 2] feature numbers.
        counts: features of each frame.

    Returns:
        Tracks of two observations or more.
    """
    first = np.concatenate([[0], np.cumsum(counts)]).tolist()
    frame = np.repeat(np.arange(len(counts)), counts)
    root = list(range(first[-1]))
    # The frames of each root's track, one bit per frame.
    shown = [1 << t for t in frame.tolist()]

    def find(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for a, b in sorted(matches, key=lambda pair: (pair[1] - pair[0], pair)):
        for i, j in matches[a, b].tolist():
            left, right = find(first[a] + i), find(first[b] + j)
            if not shown[left] & shown[right]:
                root[right] = left
                shown[left] |= shown[right]
    label = np.array([find(i) for i in range(first[-1])], dtype=int)
    keep = np.bincount(label, minlength=len(label))[label] >= 2
    _, track = np.unique(label[keep], return_inverse=True)
    feature = np.arange(first[-1]) - np.asarray(first)[frame]
    return Tracks(frame[keep], feature[keep], track, int(track.max(initial=-1)) + 1)
