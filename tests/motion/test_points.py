"""Which points of a map are surely in their place."""

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.motion.points import sure_sightings


def test_points_seen_often_and_from_more_than_one_side_are_sure() -> None:
    """Of three points one is seen in all frames, one in a few, one in many that look from the same side."""
    turns = np.concatenate([np.linspace(-30.0, 30.0, 12), np.full(12, 30.0)])
    seen = [range(24), (0, 6, 11), range(12, 24)]
    frame, track = np.array([(t, n) for n, frames in enumerate(seen) for t in frames]).T
    map_ = SimpleNamespace(
        points=np.array([[0.0, 0.0, -0.05], [0.02, 0.0, -0.05], [0.0, 0.02, -0.05], [0.0, 0.0, 0.0]]),
        rotations=Rotation.from_euler("y", turns[:, None], degrees=True).as_matrix(),
        transl=np.tile([0.0, 0.0, 0.6], (24, 1)),
        frame=frame,
        track=track,
        # The last sighting of the first point is not believed.
        use=lambda: ~((track == 0) & (frame == 23)),
    )
    found = sure_sightings(map_, np.array([2, 1, 0]))
    assert sorted(map(tuple, found.tolist())) == [(t, 2) for t in range(23)]
    assert sure_sightings(map_, np.array([3])).shape == (0, 2)
