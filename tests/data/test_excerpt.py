"""Excerpts of a clip: every array follows the chosen frames."""

from __future__ import annotations

import numpy as np

from bigs.data.base import Clip
from bigs.data.excerpt import excerpt, to_and_fro


def test_to_and_fro() -> None:
    assert to_and_fro(4, 3).tolist() == [0, 1, 2]
    assert to_and_fro(4, 12).tolist() == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1]
    assert to_and_fro(1, 3).tolist() == [0, 0, 0]
    assert to_and_fro(2, 5).tolist() == [0, 1, 0, 1, 0]


def test_everything_follows_the_frames(tiny: Clip) -> None:
    frames = np.array([3, 1, 1])
    short = excerpt(tiny, frames)
    assert len(short) == 3
    assert short.frame_names == tuple(tiny.frame_names[t] for t in frames)
    for t, source in enumerate(frames):
        assert (short.image(t) == tiny.image(source)).all()
        assert (short.mask(t) == tiny.mask(source)).all()
    for side, track in tiny.hands.items():
        for name in ("global_orient", "hand_pose", "transl", "valid"):
            assert (getattr(short.hands[side], name) == getattr(track, name)[frames]).all()
    assert short.object is not None and tiny.object is not None
    for name in ("rotations", "transl", "valid"):
        assert (getattr(short.object, name) == getattr(tiny.object, name)[frames]).all()
    assert (short.cam_from_world == tiny.cam_from_world[frames]).all()
    assert all((short.mask_areas[e] == tiny.mask_areas[e][frames]).all() for e in tiny.mask_areas)
    # Nothing of the clip's length is left.
    for holder in (short, short.object, *short.hands.values()):
        arrays = {name: value for name, value in vars(holder).items() if isinstance(value, np.ndarray)}
        assert [name for name, value in arrays.items() if value.shape[0] == len(tiny)] == []
