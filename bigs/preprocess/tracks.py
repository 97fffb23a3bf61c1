"""Feature tracks: matches of pairs of frames joined into the sightings of one point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph


class Tracks(NamedTuple):
    """Sightings, sorted by frame; a track has at most one in a frame."""

    frame: np.ndarray  # [M]
    feature: np.ndarray  # [M] which of the frame's features
    track: np.ndarray  # [M]
    total: int  # number of tracks


def join_matches(matches: Mapping[tuple[int, int], np.ndarray], counts: Sequence[int]) -> Tracks:
    """Connected components of matches; where one holds several features of a frame, those are left out.

    Args:
        matches: of pairs of frames, each [n, 2] feature numbers.
        counts: features of each frame.

    Returns:
        Tracks of two sightings or more.
    """
    first = np.concatenate([[0], np.cumsum(counts)])
    pairs = [pair + first[[a, b]] for (a, b), pair in matches.items() if len(pair)]
    edges = np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=int)
    graph = scipy.sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(first[-1], first[-1]))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    frame = np.repeat(np.arange(len(counts)), counts)
    feature = np.arange(first[-1]) - first[frame]
    _, place, again = np.unique(label * len(counts) + frame, return_inverse=True, return_counts=True)
    alone = again[place] == 1
    # Only sightings that stay count towards a track's length.
    length = np.bincount(label[alone], minlength=label.max(initial=-1) + 1)
    keep = alone & (length[label] >= 2)
    _, track = np.unique(label[keep], return_inverse=True)
    return Tracks(frame[keep], feature[keep], track, int(track.max(initial=-1)) + 1)
