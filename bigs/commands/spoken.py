"""Progress as lines, for logs and pipes."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

# Seconds after which progress is printed, even if nothing new has begun.
PATIENCE = 30.0
# In "step 12/300" or "30 frames", words say what is done and numbers how far it is.
_COUNT = re.compile(r"\d+")


class Spoken:
    """Prints a line when something begins; `remind` prints the current state after a long silence."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._lock = threading.Lock()
        self._place = ""
        self._began = self._last = time.monotonic()

    def say(self, text: str) -> None:
        """A line, now."""
        with self._lock:
            self._place, self._last = text, time.monotonic()
            self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def update(self, text: str) -> None:
        """A line if it tells more than how far the same thing is."""
        if _COUNT.sub("", text) != _COUNT.sub("", self._place):
            self.say(text)
        else:
            self.at(text)

    def at(self, text: str) -> None:
        """Where it is, for the next reminder."""
        with self._lock:
            self._place = text

    def remind(self, patience: float) -> None:
        """A line if the last is `patience` seconds old."""
        if self._place and time.monotonic() - self._last >= patience:
            self.say_again()

    def say_again(self) -> None:
        place = self._place
        self.say(f"{place} (after {time.monotonic() - self._began:.0f} s)")
        self.at(place)


@contextmanager
def spoken(console: Console, patience: float = PATIENCE) -> Iterator[Spoken]:
    """Lines on a console while the block runs; after the first, one at least every `patience` seconds."""
    lines, ended = Spoken(console), threading.Event()

    def watch() -> None:
        while not ended.wait(patience / 4.0):
            lines.remind(0.75 * patience)

    thread = threading.Thread(target=watch, name="reminders", daemon=True)
    thread.start()
    try:
        yield lines
    finally:
        ended.set()
        thread.join()
