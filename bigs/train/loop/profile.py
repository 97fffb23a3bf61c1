"""Where the time of a run goes: stages, and within a step fields, engine, losses and optimiser.

Functions are replaced by timed ones only while `profiled` is open; ordinary runs are not affected.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest import mock

import torch

from bigs.models.posed_scene import PosedScene
from bigs.models.scene import Scene
from bigs.raster import rust
from bigs.train.loop import step, terms
from bigs.train.loop.optim import FrameAdam

# The parts of a step's time; what belongs to none is the stage's `rest`.
PHASES = (
    "fields",  # canonical Gaussians from triplanes and decoders
    "posing",  # Gaussians, vertices and joints carried to the frames
    "engine",  # rendering
    "losses",
    "engine backward",
    "fields backward",
    "posing and losses backward",
    "optimiser",
)
_FIELDS, _POSING, _ENGINE, _LOSSES, _ENGINE_BACK, _FIELDS_BACK, _BACK, _OPTIMISER = PHASES


@dataclass
class StageTimes:
    """One stage of a run: seconds."""

    wall: float = 0.0
    cpu: float = 0.0  # CPU time of all threads
    steps: int = 0
    in_steps: float = 0.0  # wall seconds of the steps alone
    phases: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))

    @property
    def rest(self) -> float:
        """Time outside all phases: reading images, keeping states, checkpoints, logs."""
        return self.wall - sum(self.phases.values())


class Profile:
    """Times by stage, in the order of the run. The first is what comes before any stage."""

    def __init__(self) -> None:
        self.stages: dict[str, StageTimes] = {}
        self._open: list[str] = []  # running phases, the innermost last
        self._current = StageTimes()
        self._since = 0.0  # when time was last assigned to a phase
        self._began = (0.0, 0.0)

    def listen(self, event: dict[str, Any]) -> None:
        """Follow a run's events: a stage ends where the next is spoken of."""
        name = event.get("stage")
        if name is not None and self.stages.get(name) is not self._current:
            self.begin(name)
        if event["event"] == "step":
            self._current.steps += 1
            self._current.in_steps += event["seconds"]

    def begin(self, name: str) -> None:
        """Begin stage `name`."""
        self.finish()
        self._current = self.stages.setdefault(name, StageTimes())

    def finish(self) -> None:
        """Give the time until now to the stage that runs."""
        now = time.perf_counter(), time.process_time()
        self._current.wall += now[0] - self._began[0]
        self._current.cpu += now[1] - self._began[1]
        self._began = now

    def spent(self) -> tuple[float, float]:
        """Wall and CPU seconds of all stages until now."""
        self.finish()
        return sum(s.wall for s in self.stages.values()), sum(s.cpu for s in self.stages.values())

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What happens inside belongs to no stage; not within a phase."""
        self.finish()
        running, self._current = self._current, StageTimes()
        try:
            yield
        finally:
            self.finish()
            self._current = running

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._open:
            self._current.phases[self._open[-1]] += now - self._since
        self._since = now

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time spent inside, without what is spent in phases within, belongs to phase `name`."""
        self._charge()
        self._open.append(name)
        try:
            yield
        finally:
            self._charge()
            self._open.pop()

    def reached_fields(self, gradient: torch.Tensor) -> None:
        """A backward pass has come back to what the fields gave: all that is left of it is theirs.

        Autograd goes from what was computed last to what was computed first, which are the fields.
        """
        self._charge()
        if self._open and self._open[-1] == _BACK:
            self._open[-1] = _FIELDS_BACK


def _timed(profile: Profile, phase: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def timed(*args: Any, **kwargs: Any) -> Any:
        with profile.phase(phase):
            return function(*args, **kwargs)

    return timed


def _timed_fields(profile: Profile, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def timed(*args: Any, **kwargs: Any) -> Any:
        with profile.phase(_FIELDS):
            canonical = function(*args, **kwargs)
            for value in {id(v): v for subject in canonical.values() for v in subject}.values():
                if value is not None and value.requires_grad:
                    value.register_hook(profile.reached_fields)
            return canonical

    return timed


@contextmanager
def profiled() -> Iterator[Profile]:
    """A profile of what runs inside; its `listen` must hear the run's events."""
    profile = Profile()
    functions: list[tuple[Any, str, str]] = [
        *((PosedScene, name, _POSING) for name in ("posed", "verts", "joints", "object_points")),
        (step, "rasterization", _ENGINE),
        (step, "covered_shares", _ENGINE),
        (rust._raster, "rasterize_backward", _ENGINE_BACK),
        (rust._raster, "outline_backward", _ENGINE_BACK),
        (torch.Tensor, "backward", _BACK),
        (FrameAdam, "step_frames", _OPTIMISER),
    ]
    with ExitStack() as stack:
        for owner, name, phase in functions:
            timed = _timed(profile, phase, getattr(owner, name))
            stack.enter_context(mock.patch.object(owner, name, timed))
        stack.enter_context(mock.patch.object(Scene, "canonical", _timed_fields(profile, Scene.canonical)))
        for known in (terms.TERMS, *terms.IMAGE_TERMS.values()):
            timed_terms = {
                name: replace(term, loss=_timed(profile, _LOSSES, term.loss)) for name, term in known.items()
            }
            stack.enter_context(mock.patch.dict(known, timed_terms))
        profile._began = time.perf_counter(), time.process_time()
        profile.begin("start values")
        yield profile
        profile.finish()
