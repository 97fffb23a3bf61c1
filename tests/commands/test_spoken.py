"""Lines where there is no terminal: one for each thing, and reminders while one thing takes long."""

from __future__ import annotations

import io
import threading

from rich.console import Console

from bigs.commands.progress import progress_listener
from bigs.commands.spoken import Spoken, spoken
from bigs.train.plan.presets import PRESETS


class _Heard(io.StringIO):
    """Text, and an event for every line."""

    def __init__(self) -> None:
        super().__init__()
        self.reminded = threading.Event()

    def write(self, text: str) -> int:
        if "(after" in text:
            self.reminded.set()
        return super().write(text)


def test_a_line_for_each_thing_and_not_for_how_far_it_is() -> None:
    text = io.StringIO()
    lines = Spoken(Console(file=text))
    for line in ("run: contact 1/9", "run: contact 2/9", "run: joint 1/9", "1 frames", "2 frames"):
        lines.update(line)
    assert text.getvalue().splitlines() == ["run: contact 1/9", "run: joint 1/9", "1 frames"]


def test_long_parts_say_where_they_are() -> None:
    heard = _Heard()
    with spoken(Console(file=heard), patience=0.02) as lines:
        lines.say("contact")
        lines.at("contact: step 7/9")
        assert heard.reminded.wait(60)
    assert "contact: step 7/9 (after " in heard.getvalue()


def test_nothing_is_said_before_something_begins() -> None:
    heard = _Heard()
    with spoken(Console(file=heard), patience=0.01):
        assert not heard.reminded.wait(0.1)
    assert heard.getvalue() == ""


def test_a_run_without_a_terminal_names_its_stages() -> None:
    text = io.StringIO()
    with progress_listener(Console(file=text), PRESETS["smoke"]) as listen:
        listen({"event": "stage", "stage": "contact", "index": 1, "stages": 4})
        listen({"event": "step", "stage": "contact", "step": 1, "steps": 2, "loss": 0.5})
        listen({"event": "note", "stage": "outputs", "text": "writing results"})
    assert text.getvalue().splitlines() == ["2/4 contact", "writing results"]


def test_a_finished_bar_has_no_time_left() -> None:
    text = io.StringIO()
    first = PRESETS["smoke"].stages[0].name
    with progress_listener(Console(file=text, force_terminal=True, width=100), PRESETS["smoke"]) as listen:
        listen({"event": "stage", "stage": first, "index": 0, "stages": 4})
        listen({"event": "note", "stage": "outputs", "text": "drawing pictures"})
    _, _, last = text.getvalue().rpartition("drawing pictures")
    assert "0:00:00" in last
    assert "left" not in last
