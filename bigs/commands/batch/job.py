"""One attempt at one clip of a batch, as every engine runs it, and the status that it leaves."""

from __future__ import annotations

import os
import socket
import time
import traceback
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from bigs.checks import InputError
from bigs.commands.folder.contents import CONFIG, SCENE, read_scores, write_json
from bigs.commands.run.reconstruct import reconstruct
from bigs.commands.run.series import PlannedRun
from bigs.files import read_json
from bigs.threads import limit_threads

STATUS = "status.json"
JOB_LOG = "batch.log"

State = Literal["waiting", "running", "finished", "failed"]


@dataclass(frozen=True)
class Job:
    """A planned run as a part of a batch."""

    run: PlannedRun
    threads: int  # CPU threads
    batch: str  # number of the call of the batch command; attempts are counted per call

    @property
    def name(self) -> str:
        return self.run.folder.name


@dataclass(frozen=True)
class Status:
    """The state of a clip; `status.json` in its folder."""

    state: State = "waiting"
    attempts: int = 0  # in this call of the batch command
    batch: str = ""
    host: str = ""
    pid: int = 0
    started: str = ""  # of the last attempt
    seconds: float = 0.0  # of the last attempt
    error: str = ""
    again: bool = True  # whether another attempt could succeed
    scores: dict[str, float] = field(default_factory=dict)


def read_status(folder: Path) -> Status:
    """The status of a clip; "waiting" if there is none that can be read."""
    try:
        stored = read_json(folder / STATUS)
        return Status(**{name.name: stored[name.name] for name in fields(Status)})
    except (InputError, KeyError, TypeError):
        return Status()


def write_status(folder: Path, status: Status) -> None:
    write_json(folder / STATUS, asdict(status))


def is_finished(folder: Path) -> bool:
    """Whether the clip is finished and its result exists."""
    return read_status(folder).state == "finished" and (folder / SCENE).is_file()


def run_job(job: Job) -> None:
    """Reconstruct one clip, or continue an interrupted attempt; a finished clip is left alone.

    Errors of the clip are not raised: `status.json` says how it ended, and the clip's `batch.log` has one
    line for each event and the traceback of a failure.
    """
    folder = job.run.folder
    if is_finished(folder):
        return
    folder.mkdir(parents=True, exist_ok=True)
    before = read_status(folder)
    status = Status(
        state="running",
        attempts=1 + (before.attempts if before.batch == job.batch else 0),
        batch=job.batch,
        host=socket.gethostname(),
        pid=os.getpid(),
        started=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    write_status(folder, status)
    began = time.monotonic()
    with (folder / JOB_LOG).open("a", encoding="utf-8") as log:

        def say(text: str) -> None:
            log.write(f"{datetime.now(UTC).isoformat(timespec='seconds')} {text}\n")
            log.flush()

        def listen(event: dict[str, Any]) -> None:
            if event["event"] in ("stage", "note"):
                say(event.get("text") or f"stage {event['stage']}")

        say(f"attempt {status.attempts} on {status.host}, process {status.pid}")
        error, again = "", False
        try:
            limit_threads(job.threads)
            reconstruct(
                job.run.clip,
                folder,
                job.run.config,
                hand_model=job.run.hand_model,
                ground_truth=job.run.ground_truth,
                resume=(folder / CONFIG).exists(),
                listen=listen,
            )
        except InputError as bad:
            # The same files would be refused again.
            error = str(bad)
        except Exception as bad:
            error, again = f"{type(bad).__name__}: {bad}", True
            log.write(traceback.format_exc())
        say((error and f"failed: {error}") or "finished")
    done = asdict(status) | {"seconds": round(time.monotonic() - began, 1)}
    if error:
        write_status(folder, Status(**done | {"state": "failed", "error": error, "again": again}))
    else:
        scores = read_scores(folder).get("result", {})
        write_status(folder, Status(**done | {"state": "finished", "scores": scores}))
