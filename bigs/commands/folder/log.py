"""log.jsonl: what happened in a run, one event per line."""

from __future__ import annotations

import json
from itertools import takewhile
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from bigs.atomic import atomic_write, named_errors
from bigs.files import read_bytes

Event = dict[str, Any]


class RunLog:
    """Events as they come. What an interrupted run did after its last checkpoint is forgotten, for it is
    done again; until that is known, the earlier file is left as it is.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path, resume: bool) -> None:
        self.path = path
        self.events: list[Event] = []
        self._earlier = read_log(path) if resume else []
        self._file: BinaryIO | None = None

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, event: Event) -> None:
        """Append an event; "resume" instead says where an interrupted run goes on."""
        if event["event"] == "resume":
            self._begin([e for e in takewhile(lambda e: _before(e, event), self._earlier) if _lasts(e)])
            return
        if self._file is None:
            self._begin([])
        if event["event"] == "stage" and event in self.events:
            return  # a stage that goes on
        self.events.append(event)
        self._write(_line(event))

    def _begin(self, events: list[Event]) -> None:
        with atomic_write(self.path) as file:
            file.write(b"".join(map(_line, events)))
        self.events = events
        # Without a buffer, so that a line is in the file when the call returns, whatever comes next.
        self._file = self.path.open("ab", buffering=0)

    def _write(self, line: bytes) -> None:
        assert self._file is not None
        with named_errors(self.path):
            while line:
                line = line[self._file.write(line) :]


def read_log(path: Path) -> list[Event]:
    """The events of a log; a last line that was cut off when the run was killed is left out."""
    events = []
    for line in read_bytes(path, "a run's log").splitlines() if path.exists() else []:
        try:
            events.append(json.loads(line))
        except ValueError:
            break
    return events


def _line(event: Event) -> bytes:
    return json.dumps(event).encode() + b"\n"


def _before(event: Event, resume: Event) -> bool:
    """Whether a logged event happened before the checkpoint that a run continues from."""
    if event["event"] == "stage":
        return bool(event["index"] < resume["index"] + (resume["step"] > 0))
    if event["event"] == "step":
        return bool((event["index"], event["step"]) <= (resume["index"], resume["step"]))
    return True  # as what stands before it


def _lasts(event: Event) -> bool:
    """Skipped lines are written at every end of a run."""
    return bool(event["event"] != "skipped")
