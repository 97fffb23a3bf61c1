"""Plans with hardly any steps, for tests that ask whether a run ends well."""

from __future__ import annotations

import copy
from dataclasses import replace

from bigs.train.plan.config import OptimizeStage, RunConfig


def short(config: RunConfig, steps: int = 2, image_size: int | None = None) -> RunConfig:
    """The same plan with hardly any steps, on images of that width if one is given."""
    stages = tuple(
        replace(stage, steps=steps, image_size=image_size or stage.image_size)
        if isinstance(stage, OptimizeStage)
        else stage
        for stage in copy.deepcopy(config.stages)
    )
    return replace(config, stages=stages)
