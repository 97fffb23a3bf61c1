"""Clips in and out: data sets' layouts, ground truth, cameras to render from, and a synthetic generator."""

from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.data.formats.hold import load_hold, write_hold
from bigs.data.formats.layouts import load_clip

__all__ = ["Clip", "HandTrack", "ObjectTrack", "load_clip", "load_hold", "write_hold"]
