"""What an interrupt leaves behind: no thread that still draws, which would abort the interpreter's end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Mapping

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs the extra 'viewer'")

from bigs.viewer.app import Viewer
from bigs.viewer.stage import Pose, Stage, Subject


@pytest.fixture
def interruptible() -> Iterator[None]:
    """What a shell starts in the background is deaf to interrupts, and so is all that it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_viewer_closes_when_its_drawing_has_ended() -> None:
    drawing, go_on, ended = threading.Event(), threading.Event(), threading.Event()

    def show(frame: int, pose: Pose) -> Mapping[str, Subject]:
        drawing.set()
        go_on.wait()
        ended.set()
        return {}

    stage = Stage("slow", 1, np.eye(3), 16, 16, np.array([0.0, 0.0, 0.5]), {}, show)
    with Viewer(stage, port=0) as viewer:
        drawing.wait()
        main = threading.main_thread().ident
        assert main is not None
        with pytest.raises(KeyboardInterrupt):
            threading.Timer(0.2, signal.pthread_kill, (main, signal.SIGINT)).start()
            viewer.wait()
        assert not ended.is_set()
        # The viewer is closing by then, or will be.
        threading.Timer(0.2, go_on.set).start()
    assert ended.is_set()


def test_what_fails_while_drawing_ends_the_wait() -> None:
    def show(frame: int, pose: Pose) -> Mapping[str, Subject]:
        raise RuntimeError("nothing to show")

    stage = Stage("broken", 1, np.eye(3), 16, 16, np.array([0.0, 0.0, 0.5]), {}, show)
    with Viewer(stage, port=0) as viewer, pytest.raises(RuntimeError, match="nothing to show"):
        viewer.wait()
