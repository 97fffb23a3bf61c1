"""Clips play at their own rate, whatever it is."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs the extra 'viewer'")

from bigs.viewer.app import Viewer
from bigs.viewer.stage import Stage


@pytest.mark.parametrize("fps", [0.2, 24.0, 240.0])
def test_a_clip_of_any_rate_can_be_opened(fps: float) -> None:
    middle = np.array([0.0, 0.0, 0.5])
    stage = Stage("clip", 3, np.eye(3), 16, 16, middle, {}, lambda frame, pose: {}, fps=fps)
    with Viewer(stage, port=0) as viewer:
        assert viewer.url
