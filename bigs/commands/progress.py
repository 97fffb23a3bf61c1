"""A progress display with time left, fed by a run's events."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from bigs.commands.spoken import Spoken, spoken
from bigs.train.plan.config import GuidanceStage, OptimizeStage, RunConfig, Stage


@contextmanager
def progress_listener(console: Console, config: RunConfig) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Show one bar over all stages, or lines where there is no terminal; yields what to pass as `listen`."""
    if not console.is_terminal:
        with spoken(console) as lines:
            yield functools.partial(_speak, lines)
        return
    bar = _RunBar(console, config)
    try:
        yield bar.listen
    finally:
        bar.stop()


@contextmanager
def steps_listener(console: Console, description: str) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Show one bar over steps that take equal time, or lines where there is no terminal.

    What is yielded hears "start", with "step" (done before) and what the networks weigh, and "step".
    """
    if not console.is_terminal:
        with spoken(console) as lines:
            lines.say(description)
            yield functools.partial(_speak, lines)
        return
    progress = _bar(console)
    task = progress.add_task(description, total=None, detail="")

    def listen(event: dict[str, Any]) -> None:
        progress.start()
        if event["event"] == "start":
            progress.console.print(_weights(event), highlight=False)
            progress.reset(task, completed=event["step"])
        elif event["event"] == "step":
            detail = f"step {event['step']}/{event['steps']}, loss {event['loss']:.4f}"
            progress.update(task, total=event["steps"], completed=event["step"], detail=detail)

    try:
        yield listen
    finally:
        if progress.live.is_started:
            progress.stop()


def _speak(lines: Spoken, event: dict[str, Any]) -> None:
    """A line for each stage and each note; reminders report the steps."""
    if event["event"] == "stage":
        lines.say(f"{event['index'] + 1}/{event['stages']} {event['stage']}")
    elif event["event"] == "note":
        lines.say(event["text"])
    elif event["event"] == "start":
        lines.say(_weights(event))
    elif event["event"] == "step":
        stage = f"{event['stage']}: " if "stage" in event else ""
        lines.at(f"{stage}step {event['step']}/{event['steps']}, loss {event['loss']:.4f}")


def _weights(event: dict[str, Any]) -> str:
    return f"networks: {event['weights_gib']:.2f} GiB"


class _RunBar:
    """One bar over the stages of a run.

    It counts pixels times frames times steps, which is what time goes with, not steps alone. When they are
    done it says what is done to the results, and no time left.
    """

    def __init__(self, console: Console, config: RunConfig) -> None:
        guided = config.prior.kind in ("trained", "sd")
        self._stages = [s for s in config.stages if guided or not isinstance(s, GuidanceStage)]
        self._cost = {
            stage.name: (stage.image_size or 480) ** 2 * (stage.frames_per_step or 60)
            for stage in self._stages
            if isinstance(stage, OptimizeStage)
        }
        self._cost |= {
            s.name: s.image_size**2 * s.views for s in self._stages if isinstance(s, GuidanceStage)
        }
        self._total = sum(map(self._work, self._stages))
        self._done = 0
        self._progress = _bar(console)
        self._task = self._progress.add_task("start values", total=self._total, detail="")

    def _work(self, stage: Stage) -> int:
        return self._cost.get(stage.name, 0) * int(getattr(stage, "steps", 0))

    def listen(self, event: dict[str, Any]) -> None:
        # Only once something happens: bad input is answered by one sentence and nothing else.
        self._progress.start()
        if event["event"] == "stage":
            self._done = sum(map(self._work, self._stages[: event["index"]]))
            place = f"{event['index'] + 1}/{event['stages']} {event['stage']}"
            self._progress.update(self._task, description=place, detail="", completed=self._done)
        elif event["event"] == "step":
            self._progress.update(
                self._task,
                completed=self._done + self._cost[event["stage"]] * event["step"],
                detail=f"step {event['step']}/{event['steps']}, loss {event['loss']:.4f}",
            )
        elif event["event"] == "note" and event["stage"] == "outputs":
            self._progress.update(
                self._task, description=event["text"], detail="", completed=self._total, total=self._total
            )
        elif event["event"] == "note":
            self._progress.console.print(event["text"], highlight=False)

    def stop(self) -> None:
        if self._progress.live.is_started:
            self._progress.stop()


class _Times(ProgressColumn):
    """How long it has been at work and, while that can be told, how long it still will be."""

    def render(self, task: Task) -> Text:
        began = task.start_time
        elapsed = 0 if began is None else int(task.get_time() - began)
        left = None if task.finished or not task.completed else task.time_remaining
        text = str(timedelta(seconds=elapsed))
        return Text(text if left is None else f"{text}, {timedelta(seconds=int(left))} left")


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[detail]}"),
        _Times(),
        console=console,
    )
