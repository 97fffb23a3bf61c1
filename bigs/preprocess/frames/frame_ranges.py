"""Words for what was found in which frames."""

from __future__ import annotations

import numpy as np


def frame_ranges(frames: np.ndarray) -> str:
    """Frames [T] (bool) as text: "frames 3, 7-9"."""
    index = np.flatnonzero(frames)
    runs = np.split(index, np.flatnonzero(np.diff(index) > 1) + 1)
    text = ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
    return f"frame {text}" if len(index) == 1 else f"frames {text}"
