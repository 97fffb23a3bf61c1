"""Bounds of every number of a configuration, checked where it is read."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

from bigs.checks import InputError, shown
from bigs.fields.decoders import DecoderConfig
from bigs.fields.triplane import TriplaneConfig
from bigs.models.hand_splats import HandSplatsConfig
from bigs.models.object_splats import ObjectSplatsConfig
from bigs.motion.bundle import BundleConfig
from bigs.motion.features import FeatureConfig
from bigs.motion.focal import FocalConfig
from bigs.motion.follow import FollowConfig
from bigs.motion.object_map import MapConfig
from bigs.motion.patches import PatchConfig
from bigs.motion.tracker_config import TrackerConfig
from bigs.raster.settings import RasterSettings
from bigs.train.plan.config import (
    GraspDepthStage,
    GraspStage,
    GuidanceStage,
    MoveStage,
    ObjectMotionStage,
    OpeningConfig,
    OptimizeStage,
    RefineStage,
    RunConfig,
    ScaleSearchStage,
    SplitStage,
)
from bigs.train.plan.start_config import CompletionConfig, InitialConfig


class Range(NamedTuple):
    """Bounds of a number; an open one is no value itself."""

    low: float
    high: float
    open: bool = False

    def __contains__(self, value: object) -> bool:
        # A comparison with NaN is false.
        assert isinstance(value, int | float)
        return self.low < value < self.high if self.open else self.low <= value <= self.high

    def __str__(self) -> str:
        low, high = (f"{bound:g}" if bound < _EXACT else str(bound) for bound in (self.low, self.high))
        return f"more than {low} and less than {high}" if self.open else f"{low} to {high}"


# Whole bounds are shown in full.
_EXACT = 1e12
# No number of a plan is negative. The limit of weights, rates, lengths and steps is a million times that of
# presets, and still far within float32.
_ANY = Range(0.0, 1e9)
_SHARE = Range(0.0, 1.0)
# A logit is taken of these.
_INSIDE = Range(0.0, 1.0, open=True)
_POSITIVE = Range(0.0, 1e9, open=True)
# Network widths, texels, grid cells, which decide about memory. Presets have 24 to 256.
_CELLS = Range(1, 4096)
_PIXELS = Range(0, 1 << 16)
_COUNT = Range(1, 10**6)

# By the number's class and name.
RANGES: dict[type, dict[str, Range]] = {
    # Range of seeds of both random generators.
    RunConfig: {"seed": Range(0, 2**63 - 1), "checkpoint_every": Range(1, 10**9)},
    TriplaneConfig: {"features": _CELLS, "resolution": Range(2, 4096), "init_std": Range(0.0, 100.0)},
    DecoderConfig: {"appearance_width": _CELLS, "geometry_width": _CELLS, "skinning_width": _CELLS},
    HandSplatsConfig: {
        "subdivisions": Range(0, 4),  # each level multiplies by four
        "scale_per_spacing": _POSITIVE,
        "flatness": _POSITIVE,
        "opacity": _INSIDE,
        "color": _INSIDE,
    },
    ObjectSplatsConfig: {
        "n_gaussians": Range(10, 10**7),
        "scale_per_spacing": _POSITIVE,
        "flatness": _POSITIVE,
        "opacity": _INSIDE,
    },
    InitialConfig: {
        "interpolated_trust": _SHARE,
        "surface_resolution": Range(8, 1000),
        "surface_agreeing": _COUNT,
        "surface_smoothing": Range(0.0, 100.0),
        "seen_frames": _COUNT,
        "surface_guessed": _SHARE,
        "surface_kept": Range(0.01, 1e9),
    },
    RasterSettings: {
        "near_plane": _POSITIVE,
        "far_plane": Range(0.0, 1e30, open=True),
        "alpha_threshold": Range(0.0, 0.999),
        "max_alpha": _INSIDE,
        "min_transmittance": Range(0.0, 0.999),
    },
    CompletionConfig: {"enough": _SHARE},
    OpeningConfig: {"frames": _COUNT, "share": _SHARE},
    OptimizeStage: {"image_size": _PIXELS, "final_lr": _SHARE, "adam_betas": Range(0.0, 0.9999999)},
    ScaleSearchStage: {
        "span": Range(0.0, 0.999),
        "candidates": Range(1, 10**4),
        "image_size": _PIXELS,
        "frames": _COUNT,
    },
    GraspStage: {
        "least": Range(2, 10**9),
        **dict.fromkeys(("free", "excess", "error_aside", "error_along", "alike"), _POSITIVE),
        "image_size": _PIXELS,
    },
    GraspDepthStage: {
        "span": Range(0.0, 0.999, open=True),
        "candidates": Range(3, 10**4),
        **dict.fromkeys(("reach", "error_aside", "error_along", "error_hidden", "size_error"), _POSITIVE),
        "image_size": _PIXELS,
    },
    MoveStage: {"image_size": _PIXELS, "best": _COUNT, "gain": _SHARE, "loose_gain": _SHARE},
    ObjectMotionStage: {"calibrated_automatic": _SHARE},
    TrackerConfig: {
        "overlap": _COUNT,
        "turn_sigma": _POSITIVE,
        "shift_sigma": _POSITIVE,
        "reaches": _POSITIVE,
        "caution": _POSITIVE,
        "given_caution": _POSITIVE,
    },
    FeatureConfig: {
        "upscale": _POSITIVE,
        "first_octave": Range(-1, 4),
        "max_side": Range(16, 1 << 16),
        "max_features": _COUNT,
    },
    FollowConfig: {"levels": _COUNT, "half": Range(1, 100), "guides": _COUNT},
    FocalConfig: {
        "calibrated": _SHARE,
        **dict.fromkeys(("calibrated_sigma", "guessed_sigma", "pixel_sigma"), _POSITIVE),
        "most_observations": _COUNT,
    },
    MapConfig: {"keep_error": _POSITIVE, "least_observations": Range(2, 10**6)},
    PatchConfig: {
        "max_side": Range(16, 1 << 16),
        "half": Range(1, 100),
        "neighbours": Range(3, 1000),
        **dict.fromkeys(("least_error", "unrecognised_error"), _POSITIVE),
    },
    BundleConfig: {
        "pixel_sigma": _POSITIVE,
        "turn_sigma": _POSITIVE,
        "shift_sigma": _POSITIVE,
        "anchor_outlier": _POSITIVE,
    },
    SplitStage: {"parts": Range(1, 10), "overlap": Range(1.0, 4.0), "least_opacity": _SHARE},
    RefineStage: {
        "image_size": _PIXELS,
        "error_share": _SHARE,
        "parts": Range(1, 10),
        "least_opacity": _SHARE,
    },
    GuidanceStage: {
        "views": Range(1, 1000),
        "image_size": Range(16, 1 << 12),
        "t_first": _SHARE,
        "t_last": _SHARE,
        # More than everything is never seen, so nothing is skipped.
        "enough": Range(0.0, 10.0),
        "well_seen": Range(0.0, 10.0),
    },
}


def check_ranges(where: str, config: Any) -> None:
    """Refuse a configuration, or a part of one, with a number out of its range.

    Raises:
        InputError: the first such number, by its path below `where`; NaN and infinities are in no range.
    """
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        within = RANGES.get(type(config), {}).get(entry.name, _ANY)
        _check_value(f"{where}.{entry.name}", value, within)


def _check_value(where: str, value: Any, within: Range) -> None:
    if dataclasses.is_dataclass(value):
        check_ranges(where, value)
    elif isinstance(value, dict):
        for key, item in value.items():
            _check_value(f"{where}.{key}", item, within)
    elif isinstance(value, tuple):
        for i, item in enumerate(value):
            # Paths name stages, not their places.
            _check_value(f"{where}.{item.name}" if hasattr(item, "name") else f"{where}[{i}]", item, within)
    elif isinstance(value, int | float) and not isinstance(value, bool) and value not in within:
        raise InputError(f"{where}: expected {within}, found {shown(value)}")
