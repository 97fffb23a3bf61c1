"""The steps of preprocessing that find the object's motion and put hands and object into one metric space."""

from __future__ import annotations

from collections.abc import Callable

from bigs.commands.preprocess_request import PreprocessRequest, StepOutcome
from bigs.preprocess.artefacts import ALIGNED_FILE, SFM_FILE, read_alignment, read_frame_set, read_object_sfm


def object_step(request: PreprocessRequest, listen: Callable[[str], None]) -> StepOutcome:
    """`object_sfm.npz`."""
    frames = len(read_frame_set(request.processed).names)
    sfm = read_object_sfm(request.processed / SFM_FILE, frames)
    summary = f"{len(sfm.points)} points, a pose in {int(sfm.valid.sum())} of {frames} frames"
    return StepOutcome("object", "supplied", summary, (), None)


def align_step(request: PreprocessRequest, listen: Callable[[str], None]) -> StepOutcome:
    """`aligned.npz`."""
    frames = len(read_frame_set(request.processed).names)
    alignment = read_alignment(request.processed / ALIGNED_FILE, frames)
    return StepOutcome("align", "supplied", f"{alignment.scale:.4g} metres per unit", (), None)
