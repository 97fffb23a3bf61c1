"""A plan at the rate of a clip.

Plans are written for clips of `USUAL_FPS` frames a second. At another rate as many seconds hold more or fewer
frames, and hands and object move less or more from one to the next.
"""

from __future__ import annotations

from dataclasses import replace

from bigs.motion.tracker_config import TrackerConfig
from bigs.train.plan.config import GraspStage, MoveStage, ObjectMotionStage, OptimizeStage, RunConfig, Stage
from bigs.types import USUAL_FPS

# By which power of the rate a term's weight grows. Changes of velocity add up like a random walk: over a
# frame's time t they leave second differences whose square is in proportion to t^3. Changes of place that do
# so leave first differences in proportion to t.
_POWERS = {"acceleration": 3, "object_acceleration": 3, "rigid": 1, "smooth": 1}


def at_rate(config: RunConfig, fps: float) -> RunConfig:
    """The plan for a clip of `fps` frames a second; as it is at `USUAL_FPS`.

    What counts frames holds as long in seconds, the price of a grasp among it, since it is a number of frames
    that it costs; but at least two frames form a grasp, and grasps are at least one apart.
    """
    if fps == USUAL_FPS:
        return config
    rate = fps / USUAL_FPS
    initial = replace(
        config.initial,
        smooth_hands=config.initial.smooth_hands * rate,
        smooth_object=config.initial.smooth_object * rate,
    )
    return replace(config, initial=initial, stages=tuple(_stage_at(stage, rate) for stage in config.stages))


def _stage_at(stage: Stage, rate: float) -> Stage:
    if isinstance(stage, ObjectMotionStage):
        return replace(stage, tracker=_tracker_at(stage.tracker, rate))
    if isinstance(stage, GraspStage):
        return replace(
            stage,
            grasp=stage.grasp * rate,
            least=_frames(stage.least, rate, 2),
            gap=_frames(stage.gap, rate, 1),
            longest_move=_frames(stage.longest_move, rate, 2),
            alike=stage.alike * rate,
        )
    if isinstance(stage, MoveStage):
        stage = replace(stage, loose_frames=_frames(stage.loose_frames, rate, 1))
    if isinstance(stage, OptimizeStage | MoveStage):
        weights = {name: weight * rate ** _POWERS.get(name, 0) for name, weight in stage.weights.items()}
        return replace(stage, weights=weights)
    return stage


def _tracker_at(config: TrackerConfig, rate: float) -> TrackerConfig:
    bundle = config.map.bundle
    # The standard deviations whose squares are in proportion to t^3.
    looser = rate**-1.5
    bundle = replace(bundle, turn_sigma=bundle.turn_sigma * looser, shift_sigma=bundle.shift_sigma * looser)
    return replace(config, map=replace(config.map, bundle=bundle))


def _frames(count: int, rate: float, least: int) -> int:
    """As many seconds in frames, and not fewer frames than `least`, unless there were fewer anyway."""
    return max(min(count, least), int(count * rate + 0.5))
