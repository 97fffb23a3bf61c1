"""Checks whether a configuration can run, before anything is computed or written."""

from __future__ import annotations

from itertools import pairwise

from bigs.checks import InputError, check_choice
from bigs.train.loop.optim import GROUPS, ONLY_FREE, ONLY_IN_FIELDS
from bigs.train.loop.terms import terms_of
from bigs.train.moves.trials import PRICED, RATED
from bigs.train.plan.config import (
    CompletionStage,
    GuidanceStage,
    MoveStage,
    ObjectMotionStage,
    OptimizeStage,
    RefineStage,
    RunConfig,
    SplitStage,
    Stage,
)
from bigs.train.plan.densify_config import DensifyConfig
from bigs.train.plan.ranges import check_ranges

# The settings that the renderer is compiled for.
COMPILED = {"tile_size": (4, 8, 16, 32), "exp_degree": (3, 4, 5)}


def check_plan(config: RunConfig) -> None:
    """Refuse a configuration that cannot run.

    Raises:
        InputError: no stage, two of one name, an unknown group or term, or a number out of range.
    """
    names = [stage.name for stage in config.stages]
    if not names:
        raise InputError("config.stages: expected at least one stage, found none")
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        raise InputError(f"config.stages: expected unique names, found {sorted(repeated)[0]!r} twice")
    check_ranges("config", config)
    for earlier, stage in pairwise(config.stages):
        if isinstance(stage, ObjectMotionStage):
            raise InputError(
                f"config.stages.{stage.name}: expected this stage first, found it after {earlier.name}"
            )
    for stage in config.stages:
        where = f"config.stages.{stage.name}"
        if isinstance(stage, OptimizeStage):
            _check_names(where, stage)
            for name, given in (("free_frames", stage.free_frames), ("densify", stage.densify is not None)):
                if given and stage.step != "single-subject":
                    raise InputError(f"{where}: expected {name} with step single-subject, found {stage.step}")
            if stage.densify is not None:
                _check_densify(f"{where}.densify", stage, stage.densify, config.stages)
        elif isinstance(stage, MoveStage):
            for group in stage.lrs:
                check_choice(where, group, RATED, "groups")
            for term in stage.weights:
                check_choice(where, term, PRICED, "terms")
    _check_parameters(config)
    for name, (*others, last) in COMPILED.items():
        value = getattr(config.raster, name)
        if value not in (*others, last):
            known = ", ".join(map(str, others))
            raise InputError(f"config.raster.{name}: expected {known} or {last}, found {value}")


def _check_names(where: str, stage: OptimizeStage) -> None:
    for group in stage.lrs:
        check_choice(where, group, GROUPS, "groups")
    terms_of(stage, where)


def _check_parameters(config: RunConfig) -> None:
    """Refuse a rate of something that nothing has by the time its stage runs."""
    freed: dict[str, str] = {}  # the stage with which a subject's Gaussians left their field
    for stage in config.stages:
        if isinstance(stage, SplitStage):
            freed |= dict.fromkeys(("hand", "object") if stage.hands else ("object",), stage.name)
        elif isinstance(stage, RefineStage):
            if "object" not in freed:
                raise InputError(
                    f"config.stages.{stage.name}: expected it after a split stage, found none before"
                )
        elif isinstance(stage, CompletionStage | GuidanceStage):
            return  # whether the object leaves its field there depends on the clip
        elif isinstance(stage, OptimizeStage):
            for group in stage.lrs:
                _check_group(f"config.stages.{stage.name}.lrs", group, freed.get(group.split(".")[0]))
                if group.startswith("scene.") and not config.lighting:
                    raise InputError(
                        f"config.stages.{stage.name}.lrs: expected {group} with lighting, found lighting off "
                        "(--without lighting leaves out both)"
                    )


def _check_group(where: str, group: str, freed: str | None) -> None:
    subject = group.split(".")[0]
    if freed is None and group in ONLY_FREE.get(subject, ()):
        raise InputError(f"{where}: expected {group} after a split stage, found none before")
    if freed is not None and group in ONLY_IN_FIELDS.get(subject, ()):
        raise InputError(
            f"{where}: expected {group} before the {subject} leaves its field, found it after {freed}"
        )


def _check_densify(
    where: str, stage: OptimizeStage, config: DensifyConfig, stages: tuple[Stage, ...]
) -> None:
    for other in stages[: stages.index(stage)]:
        if isinstance(other, SplitStage | CompletionStage | GuidanceStage):
            raise InputError(
                f"{where}: expected a stage in which the object has a field, found one after {other.name}"
            )
    if not {"object.geometry", "object.triplane"} & set(stage.lrs):
        raise InputError(f"{where}: expected a rate for object.geometry or object.triplane, found neither")
    # In ascending order; a comparison with NaN is false.
    orders: tuple[dict[str, float], ...] = (
        {"0": 0.0, "first": config.first, "last": config.last, "1": 1.0},
        {"every": config.every, "1": 1.0},
        {"0": 0.0, "threshold": config.threshold},
        {"0": 0.0, "small": config.small, "large": config.large},
        {"0": 0.0, "least_opacity": config.least_opacity, "1": 1.0},
        {"1": 1, "floor": config.floor, "ceiling": config.ceiling},
    )
    for order in orders:
        if not all(low <= high for low, high in pairwise(order.values())):
            found = ", ".join(map(str, order.values()))
            raise InputError(f"{where}: expected {' <= '.join(order)}, found {found}")
    if config.every <= 0.0:
        raise InputError(f"{where}.every: expected more than 0, found {config.every}")
