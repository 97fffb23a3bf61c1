"""The curve of a run: its scores at points along it, against the seconds spent until then."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bigs.commands.evaluate.picture_scores import frame_scores, means
from bigs.commands.folder.contents import write_json
from bigs.data.base import Clip
from bigs.data.excerpt import excerpt, excerpt_trajectory
from bigs.geometry.spread import spread
from bigs.metrics.report import evaluate
from bigs.models.playback import record
from bigs.models.scene import Scene
from bigs.train.fit import Waypoint
from bigs.train.loop.profile import Profile
from bigs.types import HandObjectTrajectory

# A point is scored on this many frames at most, spread evenly: all of them take seconds.
_FRAMES = 20
# In a long run points are this share of the time so far apart, so that they are even on a logarithmic axis.
_SHARE = 0.05


class Curve:
    """Scores a run at the end of every stage, and within stages as time goes by; an observer of `fit`.

    Scoring counts neither as wall nor as CPU time of the run.

    Args:
        clip: the run's clip.
        truth: of the clip's frames; None leaves image scores.
        profile: what knows the run's seconds.
        every: CPU seconds between points within a stage, or a twentieth of what the run has spent if that is
            more. 0 scores the ends of stages only.
        place: the JSON file, written anew with every point.
    """

    def __init__(
        self, clip: Clip, truth: HandObjectTrajectory | None, profile: Profile, every: float, place: Path
    ) -> None:
        count = len(clip)
        self._frames = spread(count, _FRAMES)
        self._clip = clip
        self._few = excerpt(clip, self._frames)
        self._truth = None if truth is None else excerpt_trajectory(truth, self._frames)
        self._profile, self._every, self._place = profile, every, place
        self._last = 0.0  # CPU seconds at the last point
        self._points: list[dict[str, Any]] = []

    def __call__(self, scene: Scene, waypoint: Waypoint) -> None:
        """Add a point if one is due."""
        wall, cpu = self._profile.spent()
        due = self._every > 0.0 and cpu - self._last >= max(self._every, _SHARE * cpu)
        if waypoint.step is not None and not due:
            return
        self._last = cpu
        with self._profile.paused():
            scores = self._scores(scene)
            self._points.append({**waypoint._asdict(), "wall": wall, "cpu": cpu, "scores": scores})
            write_json(self._place, {"frames": self._frames.tolist(), "points": self._points})

    def _scores(self, scene: Scene) -> dict[str, float]:
        clip = self._clip
        playback = record(scene, clip.name, clip.frame_names, clip.normalize_shift, clip.fps)
        scores = means(frame_scores(self._few, playback, at=self._frames))
        if self._truth is None:
            return scores
        return evaluate(excerpt_trajectory(playback.trajectory(), self._frames), self._truth) | scores
