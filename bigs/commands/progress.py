"""A progress display with time left, fed by a run's events."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from bigs.train.config import GuidanceStage, OptimizeStage, RunConfig


@contextmanager
def progress_listener(console: Console, config: RunConfig) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Show one bar over all stages; yields the function to pass as `listen`.

    The bar counts pixels times frames times steps, which is what time goes with, not steps alone.
    """
    guided = config.prior.kind in ("trained", "sd")
    stages = [stage for stage in config.stages if guided or not isinstance(stage, GuidanceStage)]
    cost = {
        stage.name: (stage.image_size or 480) ** 2 * (stage.frames_per_step or 60)
        for stage in stages
        if isinstance(stage, OptimizeStage)
    }
    cost |= {s.name: s.image_size**2 * s.views for s in stages if isinstance(s, GuidanceStage)}
    total = sum(cost[stage.name] * getattr(stage, "steps", 0) for stage in stages if stage.name in cost)
    progress = _bar(console)
    task = progress.add_task("start values", total=total, detail="")
    done = 0.0

    def listen(event: dict[str, Any]) -> None:
        nonlocal done
        # Not before something happens: bad input is answered by one sentence and nothing else.
        progress.start()
        if event["event"] == "stage":
            place = f"{event['index'] + 1}/{event['stages']}"
            done = sum(
                cost.get(stage.name, 0) * getattr(stage, "steps", 0) for stage in stages[: event["index"]]
            )
            progress.update(task, description=f"{place} {event['stage']}", detail="", completed=done)
        elif event["event"] == "step":
            progress.update(
                task,
                completed=done + cost[event["stage"]] * event["step"],
                detail=f"step {event['step']}/{event['steps']}, loss {event['loss']:.4f}",
            )
        elif event["event"] == "note":
            progress.console.print(event["text"], highlight=False)

    try:
        yield listen
    finally:
        if progress.live.is_started:
            progress.stop()


@contextmanager
def steps_listener(console: Console, description: str) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Show one bar over steps that take equal time; yields the function to pass as `listen`.

    It hears "start", with "step" (done before) and what the networks weigh, and "step".
    """
    progress = _bar(console)
    task = progress.add_task(description, total=None, detail="")

    def listen(event: dict[str, Any]) -> None:
        progress.start()
        if event["event"] == "start":
            progress.console.print(f"networks: {event['weights_gib']:.2f} GiB", highlight=False)
            progress.reset(task, completed=event["step"])
        elif event["event"] == "step":
            detail = f"step {event['step']}/{event['steps']}, loss {event['loss']:.4f}"
            progress.update(task, total=event["steps"], completed=event["step"], detail=detail)

    try:
        yield listen
    finally:
        if progress.live.is_started:
            progress.stop()


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[detail]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )
