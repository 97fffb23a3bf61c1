"""The options of preprocessing, and the outcome of each step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

from bigs.preprocess.artefacts import PROCESSED
from bigs.preprocess.frames.extract import FrameConfig
from bigs.preprocess.stamps import State, state_of
from bigs.types import Entity

StepName = Literal["frames", "masks", "hands", "object", "align", "build"]
# The object comes before the hands because it may tell an unknown focal length.
STEPS: tuple[StepName, ...] = ("frames", "masks", "object", "hands", "align", "build")


@dataclass(frozen=True)
class PreprocessRequest:
    """The user's options. A source that is not given is taken from the artefacts."""

    clip: Path
    source: Path | None = None  # video or folder of images
    frames: FrameConfig = field(default_factory=FrameConfig)
    masks: Path | None = None
    mask_labels: Mapping[Entity, int] | None = None
    sam2: Path | None = None  # folder of a SAM 2 video model
    clicks: Path | None = None  # its prompts
    keypoints: Path | None = None
    hands: Path | None = None  # what another hand estimator wrote
    landmarker: Path | None = None  # MediaPipe's model file
    disk: Path | None = None  # weights of DISK, to be used instead of SIFT
    lightglue: Path | None = None  # weights of LightGlue for DISK
    exhaustive: bool = False  # match every pair of frames
    hand_model: Path | None = None
    redo: bool = False

    @property
    def processed(self) -> Path:
        return self.clip / PROCESSED

    def state(self, file: Path, inputs: str) -> State:
        """What is to be done about an artefact: nothing, or to make it."""
        return "missing" if self.redo else state_of(file, inputs)


class StepOutcome(NamedTuple):
    """The outcome of a step."""

    name: StepName
    state: Literal["made", "up to date", "supplied"]
    summary: str
    notes: tuple[str, ...]
    picture: Path | None
    seconds: float = 0.0


def kept(
    name: StepName, state: State, summary: str, picture: Path, notes: tuple[str, ...] = ()
) -> StepOutcome:
    """The outcome of a step that has nothing to do."""
    shown = picture if picture.exists() else None
    if state == "supplied":
        notes = (*notes, "kept as supplied by another tool; remove it or pass --redo to make it again")
        return StepOutcome(name, "supplied", summary, notes, shown)
    return StepOutcome(name, "up to date", summary, notes, shown)
