"""The object's pose in every frame and its points, by structure from motion on its masked pixels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bigs.checks import InputError
from bigs.motion.features import FeatureConfig, FrameFeatures, extract_features
from bigs.motion.follow import FollowConfig, follow
from bigs.motion.grow import GrowConfig, grow
from bigs.motion.masks import without_gaps
from bigs.motion.models import Mapping, MappingConfig, frame_pairs, map_features
from bigs.motion.object_map import MapConfig, ObjectMap
from bigs.motion.patches import PatchConfig, Pictures, sharpen
from bigs.motion.points import color_points, normalisation, trim_points
from bigs.motion.refine import RefineConfig, refine
from bigs.motion.seed import Seed, find_seed
from bigs.motion.tracks import Tracks, join_matches
from bigs.preprocess.artefacts import ObjectSfm
from bigs.preprocess.frames.frame_ranges import frame_ranges
from bigs.preprocess.object.checks import CheckConfig, SfmChecks, check_map
from bigs.preprocess.object.learned_features import LearnedMatcher, extract_learned, match_learned
from bigs.types import MASK_VALUES


@dataclass(frozen=True)
class SfmConfig:
    """The whole of structure from motion."""

    features: FeatureConfig = field(default_factory=FeatureConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    follow: FollowConfig = field(default_factory=FollowConfig)
    map: MapConfig = field(default_factory=MapConfig)
    grow: GrowConfig = field(default_factory=GrowConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    patches: PatchConfig = field(default_factory=PatchConfig)
    checks: CheckConfig = field(default_factory=CheckConfig)
    # Number of partial models that are tried as the start.
    seeds: int = 3
    # The largest model is the safest start: another's result must have less than this share of its misfit.
    clearly_better: float = 0.97
    # If the largest model has less than this share of the frames and no result is certain, followed features
    # are mapped too.
    large_share: float = 0.33


class SfmReport(NamedTuple):
    """What a person should know about the outcome, frame by frame."""

    features: np.ndarray  # [T] features on the object
    neighbour_matches: np.ndarray  # [T] verified matches with the next frame; 0 for the last
    models: list[list[int]]  # frames of each partial model, the start first
    model: np.ndarray  # [T] index of the model that had the frame; -1 for none
    checks: SfmChecks
    focal: float  # pixels; estimated unless known
    tried: int  # partial models that were tried as the start

    def sentences(self) -> list[str]:
        """The outcome in plain words: what is wrong, with frame ranges, and what could be done."""
        words: list[str] = []
        for flag in dict.fromkeys(word for frame in self.checks.flags for word in frame):
            frames = np.array([flag in frame for frame in self.checks.flags])
            words.append(f"{frame_ranges(frames)}: {_EXPLAINED[flag]}")
        return words


_EXPLAINED = {
    "few points": "too few points of the object were seen; its motion before and after was used",
    "tied loosely": "few points connect them to the rest, so their rotation may be off by several degrees",
    "depth may be reversed": "its mirror image in depth fits better, so the object may turn the other way",
    "turn changes": "the rotation changes abruptly; check that the object really did that",
    "long step": "the object jumps between two frames",
    "models disagree": "a partial model of these frames disagrees, so their rotation may be off",
}


def structure_from_motion(
    images: Sequence[np.ndarray],
    masks: np.ndarray,
    K: np.ndarray,
    config: SfmConfig,
    *,
    known_focal: bool = True,
    matcher: LearnedMatcher | None = None,
) -> tuple[ObjectSfm, SfmReport]:
    """Poses of the object in all frames, and its points.

    Partial models come from pycolmap. The best one is checked for reversed depth and grown over the clip by
    tracking, so that models need not be joined afterwards; where neighbours have few matches, features are
    followed by their patches, too.

    Args:
        images: T arrays [H, W, 3] uint8.
        masks: [T, H, W] labels of `bigs.types.MASK_VALUES`.
        K: [3, 3] intrinsics.
        config: see there.
        known_focal: whether the focal length in `K` is right; if not, it is estimated, and `report.focal`
            is what the poses go with.
        matcher: learned features instead of SIFT (see `learned_features`).

    Returns:
        The poses, in structure from motion's own unit, and the report. Frames that the object cannot be
        placed in are filled from their neighbours; `valid` is false there.

    Raises:
        InputError: the masks do not show the object, or it has too little texture.
    """
    shown = np.flatnonzero((masks == MASK_VALUES["object"]).any((1, 2)))
    if len(shown) < _FEWEST_FRAMES:
        raise InputError(
            f"object poses: expected masks that show the object (value {MASK_VALUES['object']}) in at least "
            f"{_FEWEST_FRAMES} frames, found it in {len(shown)} of {len(masks)}"
        )
    first, last = int(shown[0]), int(shown[-1]) + 1
    clip = slice(first, last)
    object_masks = without_gaps(masks[clip] == MASK_VALUES["object"])
    size = (masks.shape[2], masks.shape[1])
    candidates = None
    if matcher is None:
        features = extract_features(images[clip], object_masks, config.features)
    else:
        features = extract_learned(images[clip], object_masks, matcher, config.features)
        candidates = match_learned(features, frame_pairs(len(features), config.mapping), size, matcher)
    mapping = map_features(features, K, size, known_focal, config.mapping, candidates)
    if not mapping.models:
        # Loose thresholds suffice, since every model is checked.
        mapping = map_features(features, K, size, known_focal, config.mapping.loosened(), candidates)
    followed, matches = follow(features, mapping.matches, images[clip], object_masks, config.follow)
    tracks = join_matches(matches, [len(frame.pixels) for frame in followed])

    def mappings() -> Iterator[Mapping]:
        yield mapping
        if max((len(model.frames) for model in mapping.models), default=0) < config.large_share * len(
            features
        ):
            known = known_focal or bool(mapping.models)
            guess = _with_focal(K, mapping.focal)
            yield map_features(followed, guess, size, known, config.mapping.loosened(), matches)

    pictures = Pictures(images[clip], object_masks, config.patches)
    attempt, tried = _best_attempt(followed, tracks, pictures, mappings(), K, config)
    if attempt is None:
        raise InputError(_nothing_found(mapping, features))
    report = _report(attempt, tried, features, (first, len(masks) - last))
    return _result(attempt.map, report, images[clip], first, config), report


# Fewer frames say nothing about depth.
_FEWEST_FRAMES = 5


class _Attempt(NamedTuple):
    map: ObjectMap
    seed: Seed
    mapping: Mapping
    model: int  # index of the model that was the start
    checks: SfmChecks
    misfit: float  # before the search for points that were never matched


def _with_focal(K: np.ndarray, focal: float) -> np.ndarray:
    """`K` with another focal length, in pixels along x; pixels keep their shape."""
    K = K.copy()
    K[0, 0], K[1, 1] = focal, focal * K[1, 1] / K[0, 0]
    return K


def _best_attempt(
    features: Sequence[FrameFeatures],
    tracks: Tracks,
    pictures: Pictures,
    mappings: Iterable[Mapping],
    K: np.ndarray,
    config: SfmConfig,
) -> tuple[_Attempt | None, int]:
    """Start from one model after another until nothing serious is found; the best fit counts, if any."""
    best: _Attempt | None = None
    tried = 0
    for mapping in mappings:
        for number, model in enumerate(mapping.models[: config.seeds]):
            map_ = ObjectMap(features, tracks, _with_focal(K, mapping.focal), config.map)
            seed = find_seed(map_, model)
            if seed is None or not map_.use().any():
                continue
            tried += 1
            grow(map_, mapping.models, config.grow)
            map_, misfit = refine(map_, tracks, mapping.models, seed.frames, config.refine)
            if not map_.use().any():
                continue
            sharpen(map_, pictures, config.patches)
            checks = check_map(map_, features, tracks, mapping.models, config.checks)
            attempt = _Attempt(map_, seed, mapping, number, checks, misfit)
            if best is None or attempt.misfit < config.clearly_better * best.misfit:
                best = attempt
            if not best.checks.doubtful().any():
                return best, tried
    return best, tried


def _nothing_found(mapping: Mapping, features: Sequence[FrameFeatures]) -> str:
    if mapping.models:
        sizes = ", ".join(str(len(model.frames)) for model in mapping.models)
        return (
            f"object poses: expected a model that moves smoothly, found {len(mapping.models)} (of {sizes} "
            "frames) that all jump; film the object turning more slowly, or supply processed/object_sfm.npz"
        )
    counts = [len(frame.pixels) for frame in features]
    matches = _neighbour_matches(mapping, len(features))[:-1]
    return (
        f"object poses: expected about 100 features a frame and 30 matches between neighbours, found "
        f"{np.median(counts):.0f} and {np.median(matches):.0f} (medians of {len(counts)} frames): the "
        "object has too little texture or hardly turns; supply its poses as processed/object_sfm.npz, "
        "or film it closer, in better light, or with a pattern on it"
    )


def _neighbour_matches(mapping: Mapping, frames: int) -> np.ndarray:
    return np.array([len(mapping.matches.get((t, t + 1), ())) for t in range(frames)])


def _report(
    attempt: _Attempt,
    tried: int,
    features: Sequence[FrameFeatures],
    outside: tuple[int, int],
) -> SfmReport:
    """The report over the whole clip; `outside` counts the frames without object at its ends."""
    before, after = outside
    mapping = attempt.mapping
    order = [attempt.model, *(i for i in range(len(mapping.models)) if i != attempt.model)]
    models = [[int(t) + before for t in mapping.models[i].frames] for i in order]
    frames = len(features)
    model = np.full(before + frames + after, -1)
    for number in reversed(range(len(models))):
        model[models[number]] = number
    pad = lambda values, fill: np.pad(values, outside, constant_values=fill)  # noqa: E731
    checks = attempt.checks
    nothing = [["few points"]]
    return SfmReport(
        features=pad(np.array([len(frame.pixels) for frame in features]), 0),
        neighbour_matches=pad(_neighbour_matches(mapping, frames), 0),
        models=models,
        model=model,
        checks=SfmChecks(
            pad(checks.observations, 0),
            pad(checks.uncertainty, 180.0),
            pad(checks.mirror, 0.0),
            pad(checks.cosine, 1.0),
            nothing * before + checks.flags + nothing * after,
        ),
        focal=mapping.focal,
        tried=tried,
    )


def _result(
    map_: ObjectMap, report: SfmReport, images: Sequence[np.ndarray], first: int, config: SfmConfig
) -> ObjectSfm:
    """The outcome over the whole clip, of which the map's frames start at `first`."""
    seen = np.bincount(map_.track[map_.use()], minlength=len(map_.points))
    tracks = np.flatnonzero(map_.known & (seen >= config.map.least_observations))
    colors = color_points(map_, tracks, images)
    keep = trim_points(map_.points[tracks])
    points = map_.points[tracks[keep]]
    # Before the first and after the last frame that shows the object, the nearest pose is used.
    place = np.clip(np.arange(len(report.model)) - first, 0, len(map_.posed) - 1)
    checks, least = report.checks, config.checks.least_observations
    many = checks.observations / (checks.observations + 4.0 * least)
    sure = many * np.exp(-checks.uncertainty / config.checks.most_uncertain)
    return ObjectSfm(
        rotations=map_.rotations[place],
        transl=map_.transl[place],
        valid=checks.observations >= least,
        confidence=np.where(checks.doubtful(), 0.0, sure),
        points=points,
        colors=colors[keep],
        norm_mat=normalisation(points),
    )
