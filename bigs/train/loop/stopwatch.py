"""The time of a run by part: each begins where another ends, so that they add up to the whole."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class Stopwatch:
    """Seconds by part. Every instant since its creation belongs to exactly one part, unless it is `paused`.

    Args:
        first: what begins now.
    """

    def __init__(self, first: str) -> None:
        self._seconds: dict[str, float] = {first: 0.0}
        self._current = first
        self._since = time.perf_counter()

    def begin(self, name: str) -> None:
        """What follows belongs to `name`; a part may be begun again and goes on then."""
        self.read()
        self._current = name
        self._seconds.setdefault(name, 0.0)

    def read(self) -> dict[str, float]:
        """Seconds of each part until now, in the order in which they began."""
        now = time.perf_counter()
        self._seconds[self._current] += now - self._since
        self._since = now
        return dict(self._seconds)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What happens inside belongs to no part."""
        self.read()
        try:
            yield
        finally:
            self._since = time.perf_counter()

    def add(self, earlier: Mapping[str, float]) -> None:
        """Count what an earlier, interrupted run took; its parts come first."""
        mine = self.read()
        both = {name: seconds + mine.get(name, 0.0) for name, seconds in earlier.items()}
        self._seconds = both | {name: seconds for name, seconds in mine.items() if name not in both}
