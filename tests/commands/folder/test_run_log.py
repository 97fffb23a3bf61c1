"""log.jsonl of a run that is interrupted and goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from bigs.commands.folder.log import RunLog, read_log


def stage(index: int) -> dict[str, Any]:
    return {"event": "stage", "index": index}


def step(index: int, number: int) -> dict[str, Any]:
    return {"event": "step", "index": index, "step": number}


NOTE, SKIPPED = {"event": "note", "text": "n"}, {"event": "skipped", "text": "s"}
# Two stages of three steps; the second was noted something in and has just begun.
FIRST = [stage(0), step(0, 1), step(0, 2), step(0, 3), stage(1), NOTE, step(1, 1), step(1, 2)]


def write(path: Path, events: list[dict[str, Any]]) -> None:
    with RunLog(path, resume=False) as log:
        for event in events:
            log.add(event)
        assert log.events == events


def test_a_log_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    write(path, FIRST)
    assert [json.loads(line) for line in path.read_text().splitlines()] == FIRST
    assert read_log(path) == FIRST
    assert read_log(tmp_path / "none") == []


@pytest.mark.parametrize(
    ("position", "kept"),
    [
        ((0, 2), FIRST[:3]),
        ((1, 0), FIRST[:4]),  # at a stage's start: what was noted in it will be noted again
        ((1, 1), FIRST[:7]),
        ((2, 0), FIRST),
    ],
)
def test_what_a_checkpoint_holds_stays(
    tmp_path: Path, position: tuple[int, int], kept: list[dict[str, Any]]
) -> None:
    path = tmp_path / "log.jsonl"
    write(path, FIRST)
    before = path.read_bytes()
    index, done = position
    with RunLog(path, resume=True) as log:
        assert path.read_bytes() == before  # nothing is lost before it is known what stays
        log.add({"event": "resume", "index": index, "step": done})
        assert read_log(path) == kept
        log.add(stage(index))
        log.add(step(index, done + 1))
    again = [stage(index)] if stage(index) not in kept else []
    assert read_log(path) == log.events == [*kept, *again, step(index, done + 1)]


def test_without_a_checkpoint_it_begins_anew(tmp_path: Path) -> None:
    """Killed before the first checkpoint: every step is done again, and logged once."""
    path = tmp_path / "log.jsonl"
    write(path, FIRST)
    with RunLog(path, resume=True) as log:
        log.add(stage(0))
    assert read_log(path) == [stage(0)]


def test_skipped_lines_of_a_finished_run_are_not_repeated(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    write(path, [*FIRST, SKIPPED])
    with RunLog(path, resume=True) as log:
        log.add({"event": "resume", "index": 2, "step": 0})
        log.add(SKIPPED)
    assert read_log(path) == [*FIRST, SKIPPED]


def test_a_line_cut_short_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    write(path, FIRST)
    path.write_bytes(path.read_bytes()[:-4])
    assert read_log(path) == FIRST[:-1]
    path.write_bytes(path.read_bytes()[:-20] + b"\xff\xfe\n")
    assert len(read_log(path)) < len(FIRST)
