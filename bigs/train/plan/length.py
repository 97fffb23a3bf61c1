"""How many steps a plan has, and plans of fewer."""

from __future__ import annotations

from dataclasses import replace

from bigs.train.plan.config import OptimizeStage, RunConfig


def planned_steps(config: RunConfig) -> dict[str, int]:
    """Steps of every stage of optimisation."""
    return {stage.name: stage.steps for stage in config.stages if isinstance(stage, OptimizeStage)}


def shortened(config: RunConfig, steps: int) -> RunConfig:
    """The plan with about `steps` steps in all, shared out as they were; each stage keeps one at least.

    Rates that fall over a stage fall as far in fewer steps. A plan that is no longer stays as it is.
    """
    total = sum(planned_steps(config).values())
    if total <= steps:
        return config
    return replace(
        config,
        stages=tuple(
            replace(stage, steps=max(1, round(stage.steps * steps / total)))
            if isinstance(stage, OptimizeStage)
            else stage
            for stage in config.stages
        ),
    )
