"""Clips for commands: of any layout, and with estimates if a reconstruction starts from them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.data.formats.layouts import load_clip
from bigs.data.oddities.exposure import with_one_exposure
from bigs.data.oddities.forearms import without_arms
from bigs.data.oddities.pace import with_pace
from bigs.data.oddities.plausible import plausible
from bigs.data.oddities.repeats import with_repeats_noted
from bigs.data.oddities.swapped_labels import with_labels_sorted
from bigs.hand import HandModel
from bigs.train.start.initial import initial_trajectory
from bigs.types import Side


def open_clip(path: Path, hand_models: Mapping[Side, HandModel]) -> Clip:
    """A clip of any layout that `bigs.data.formats.layouts` knows, with single faults repaired and noted.

    Raises:
        InputError: the clip is invalid or implausible.
    """
    clip = load_clip(path, hand_models["right"].hands_mean.double().numpy())
    wrists = {side: hand_models[side].rest_wrist(track.betas) for side, track in clip.hands.items()}
    clip = plausible(clip, wrists)
    if clip.annotated:
        return clip
    joints = initial_trajectory(clip, hand_models).joints
    clip = without_arms(with_labels_sorted(clip, joints), joints)
    return with_repeats_noted(with_pace(with_one_exposure(clip)))


def open_estimates(path: Path, hand_models: Mapping[Side, HandModel]) -> Clip:
    """A clip from which a reconstruction can start: with masks, and with estimates that are not the truth.

    Raises:
        InputError: the clip is invalid, or holds a data set's annotation.
    """
    clip = open_clip(path, hand_models)
    if clip.annotated:
        raise InputError(
            f"{path}: expected a clip with initial estimates, found a data set's ground truth, which scores "
            "runs (--gt); bigs preprocess estimates from its images, bigs convert starts from the truth"
        )
    return clip
