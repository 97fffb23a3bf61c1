"""Clips in and out: the `build` folder, ground truth, cameras to render from, and a synthetic generator."""

from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.data.hold import load_hold, write_hold

__all__ = ["Clip", "HandTrack", "ObjectTrack", "load_hold", "write_hold"]
