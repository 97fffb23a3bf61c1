"""The ingredients of the method by name, each of which can be left out of a configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from bigs.checks import InputError, check_choice
from bigs.train.loop.optim import ONLY_FREE
from bigs.train.loop.terms import IMAGE_TERMS, TERMS
from bigs.train.plan.config import (
    CompletionStage,
    GraspDepthStage,
    GraspStage,
    GuidanceStage,
    MoveStage,
    ObjectMotionStage,
    OptimizeStage,
    PriorConfig,
    RefineStage,
    RunConfig,
    ScaleSearchStage,
    SplitStage,
    Stage,
)
from bigs.train.plan.renamed import check_renamed

# Rates of fields beside poses that move with them, where Gaussians are never freed.
_FIELD_RATES = {
    "hand.triplane": 1e-2,
    "hand.appearance": 2e-3,
    "hand.geometry": 1e-3,
    "object.triplane": 1e-2,
    "object.appearance": 2e-3,
    "object.geometry": 1e-3,
}

# Terms that fields have nothing for.
_TERMS_OF_FREE_GAUSSIANS = ("color_prior", "thickness", "hand_color_prior", "hand_thickness")


@dataclass(frozen=True)
class Switch:
    """An ingredient that a run can do without."""

    text: str  # what is left out
    off: Callable[[RunConfig], RunConfig]


def without(config: RunConfig, what: str) -> RunConfig:
    """The configuration with one ingredient left out; equal to `config` where it had no part in the plan.

    Args:
        config: any plan.
        what: a name in `SWITCHES`.

    Raises:
        InputError: there is no such ingredient.
    """
    check_renamed("--without", what)
    check_choice("--without", what, SWITCHES, "ingredients and loss terms")
    return SWITCHES[what].off(config)


def without_all(config: RunConfig, names: Iterable[str]) -> tuple[RunConfig, list[str]]:
    """The configuration with several ingredients left out, and those among `names` that it did not have.

    Raises:
        InputError: as `without`, or nothing is left to do.
    """
    unused = []
    for name in names:
        less = without(config, name)
        if less == config:
            unused.append(name)
        if not any(isinstance(stage, OptimizeStage) for stage in less.stages):
            raise InputError(f"--without {name}: expected at least one stage to remain, found none")
        config = less
    return config, unused


def _terms(*names: str) -> Callable[[RunConfig], RunConfig]:
    """Leave out loss terms."""

    def less(stage: OptimizeStage | MoveStage) -> Stage:
        return replace(stage, weights=_less(stage.weights, names))

    return lambda config: _keep(config, less, change_moves=less)


def _groups(*names: str) -> Callable[[RunConfig], RunConfig]:
    """Freeze parameters."""

    def less(stage: OptimizeStage | MoveStage) -> Stage:
        return replace(stage, lrs=_less(stage.lrs, names))

    return lambda config: _keep(config, less, change_moves=less)


def _less(values: dict[str, float], names: Iterable[str]) -> dict[str, float]:
    return {name: value for name, value in values.items() if name not in names}


def _keep(
    config: RunConfig,
    change: Callable[[OptimizeStage], Stage] = lambda stage: stage,
    leave_out: type[Stage] | tuple[type[Stage], ...] = (),
    change_moves: Callable[[MoveStage], Stage] = lambda stage: stage,
) -> RunConfig:
    """The same with changed stages, without those of a kind and those that have nothing left to do."""

    def changed(stage: Stage) -> Stage:
        if isinstance(stage, MoveStage):
            return change_moves(stage)
        return change(stage) if isinstance(stage, OptimizeStage) else stage

    stages = [changed(stage) for stage in config.stages if not isinstance(stage, leave_out)]
    return replace(config, stages=tuple(stage for stage in stages if not _is_idle(stage)))


def _is_idle(stage: Stage) -> bool:
    if isinstance(stage, MoveStage):
        return not stage.lrs
    return isinstance(stage, OptimizeStage) and not (stage.lrs and stage.weights)


def _all_of(*steps: Callable[[RunConfig], RunConfig]) -> Callable[[RunConfig], RunConfig]:
    def off(config: RunConfig) -> RunConfig:
        for step in steps:
            config = step(config)
        return config

    return off


def _smooth(config: RunConfig) -> RunConfig:
    return replace(config, initial=replace(config.initial, smooth_hands=0.0))


def _no_prior(config: RunConfig) -> RunConfig:
    less = _keep(_terms("sds")(config), leave_out=(CompletionStage, GuidanceStage))
    return replace(less, prior=PriorConfig())


def _object_smooth(config: RunConfig) -> RunConfig:
    return replace(config, initial=replace(config.initial, smooth_object=0.0))


def _scale_search(config: RunConfig) -> RunConfig:
    return _keep(config, leave_out=(ScaleSearchStage, GraspDepthStage))


def _keep_fields(config: RunConfig) -> RunConfig:
    """Without the split: what trained free Gaussians after it trains their fields."""
    splits = [i for i, stage in enumerate(config.stages) if isinstance(stage, SplitStage)]
    if not splits:
        return config
    free = set().union(*ONLY_FREE.values())

    def with_fields(stage: Stage) -> Stage:
        if not isinstance(stage, OptimizeStage) or not free & set(stage.lrs):
            return stage
        subjects = {group.split(".")[0] for group in free & set(stage.lrs)}
        fields = {name: rate for name, rate in _FIELD_RATES.items() if name.split(".")[0] in subjects}
        return replace(
            stage, lrs=_less(stage.lrs, free) | fields, weights=_less(stage.weights, _TERMS_OF_FREE_GAUSSIANS)
        )

    before, after = config.stages[: splits[0]], config.stages[splits[0] :]
    of_fields = replace(config, stages=(*before, *map(with_fields, after)))
    return _keep(of_fields, leave_out=(SplitStage, RefineStage))


def _search_labels(config: RunConfig) -> RunConfig:
    return replace(
        config,
        stages=tuple(
            replace(stage, labels_weight=0.0) if isinstance(stage, ScaleSearchStage) else stage
            for stage in config.stages
        ),
    )


def _free_frames(config: RunConfig) -> RunConfig:
    return replace(
        config,
        stages=tuple(
            stage for stage in config.stages if not (isinstance(stage, OptimizeStage) and stage.free_frames)
        ),
    )


def _calibrated(stage: Stage) -> Stage:
    if not isinstance(stage, ObjectMotionStage):
        return stage
    focal = replace(stage.tracker.focal, calibrated=1.0)
    return replace(stage, tracker=replace(stage.tracker, focal=focal))


def _pyramid(config: RunConfig) -> RunConfig:
    sizes = [stage.image_size for stage in config.stages if isinstance(stage, OptimizeStage)]
    finest = 0 if 0 in sizes else max(sizes, default=0)
    return _keep(config, lambda stage: replace(stage, image_size=finest))


# Parameters of single frames, like the paper's P^t, not those of all frames or of a grasp.
_FRAME_POSES = (
    *(f"hand.{name}" for name in ("orient", "pose", "ray", "depth")),
    *(f"object.{name}" for name in ("orient", "ray", "depth")),
)
_GRASP_GROUPS = ("hand.grasp_orient", "hand.grasp_pose", "hand.grasp_position")

_INGREDIENTS = {
    "share": Switch(
        "one canonical hand and one shape for both sides",
        lambda config: replace(config, hand=replace(config.hand, shared=False)),
    ),
    "prior": Switch(
        "the completion of the object where it was never seen",
        _no_prior,
    ),
    "openings": Switch(
        "openings of the object's mesh, where hands are or hands or points are seen through it",
        lambda config: replace(config, openings=None),
    ),
    "smooth": Switch(
        "the hands' motion: the smoothing of their estimates, L_smt, acceleration of the joints",
        _all_of(_terms("smooth", "acceleration"), _smooth),
    ),
    "contact": Switch(
        "contact of hands and fingers, penetration, and the searches that they decide, of size and depths",
        _all_of(_terms("contact", "finger_contact", "penetration"), _scale_search),
    ),
    "frame_poses": Switch("pose residuals of single frames", _groups(*_FRAME_POSES)),
    "object-motion": Switch(
        "the object's motion from tracks in its pictures",
        lambda config: _keep(config, leave_out=ObjectMotionStage),
    ),
    "focal": Switch(
        "the focal length from the object's tracks: the clip's own is then taken as calibrated",
        lambda config: replace(config, stages=tuple(map(_calibrated, config.stages))),
    ),
    "object_smooth": Switch(
        "the object's motion: the smoothing of its estimates, and acceleration",
        _all_of(_terms("object_acceleration"), _object_smooth),
    ),
    "scale_search": Switch("the searches of the object's size and of grasps' depths", _scale_search),
    "grasps": Switch(
        "grasps, in which the object carries a hand",
        _all_of(
            lambda config: _keep(config, leave_out=(GraspStage, GraspDepthStage)),
            _groups(*_GRASP_GROUPS),
            _free_frames,
        ),
    ),
    "free_frames": Switch("the steps for frames between grasps", _free_frames),
    "moves": Switch(
        "the search for better poses between grasps",
        lambda config: _keep(config, leave_out=MoveStage),
    ),
    "frame_moments": Switch(
        "separate Adam moments for each frame's rotations and fingers",
        lambda config: _keep(config, lambda stage: replace(stage, frame_moments=False)),
    ),
    "lighting": Switch(
        "light and shade",
        _all_of(
            lambda config: replace(config, lighting=False),
            _terms("shade_prior"),
            _groups("scene.light", "scene.shade", "scene.ambient"),
        ),
    ),
    "ambient": Switch("ambient occlusion: shade of surfaces by each other", _groups("scene.ambient")),
    "labels": Switch(
        "the label term (who hides whom), also in the search of the object's size",
        _all_of(_terms("labels"), _search_labels),
    ),
    "pose_priors": Switch(
        "what keeps poses, depths and shape near their estimates",
        _terms(
            *("orient_prior", "pose_prior", "fingers_even", "joint_axes", "finger_tendons"),
            *("depth_prior", "betas_prior", "object_prior"),
        ),
    ),
    "hand_geometry": Switch(
        "offsets, rotations and scales of the hand's Gaussians",
        _all_of(
            lambda config: replace(config, hand=replace(config.hand, learn_geometry=False)),
            _groups("hand.geometry", "hand.shift", "hand.size"),
        ),
    ),
    "densify": Switch(
        "cloning, splitting and pruning of the object's Gaussians",
        lambda config: _keep(config, lambda stage: replace(stage, densify=None)),
    ),
    "split": Switch(
        "free Gaussians: fields stay to the end, as in the paper",
        _keep_fields,
    ),
    "refine": Switch(
        "splitting the object's Gaussians where pictures show more than they can",
        lambda config: _keep(config, leave_out=RefineStage),
    ),
    "pyramid": Switch("coarse images before fine ones", _pyramid),
    "stopping": Switch(
        "early stopping", lambda config: _keep(config, lambda stage: replace(stage, stop_patience=0))
    ),
}

_TERM_NAMES = dict.fromkeys(name for terms in (*IMAGE_TERMS.values(), TERMS) for name in terms)

# The names that `--without` accepts: ingredients of several parts, then every other loss term.
SWITCHES: dict[str, Switch] = _INGREDIENTS | {
    name: Switch(f"the loss term {name}", _terms(name)) for name in _TERM_NAMES if name not in _INGREDIENTS
}
