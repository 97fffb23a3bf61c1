"""What stands for `reconstruct` where only the series of runs matters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bigs.commands.folder.contents import CHECKPOINTS, CONFIG, LOG, METRICS, write_json
from bigs.commands.run.reconstruct import run_origin
from bigs.train.fit import Observer
from bigs.train.plan.config import RunConfig
from bigs.train.plan.config_file import save_config
from bigs.train.resolve import resolve
from bigs.train.switches import SWITCHES, without

SCORES = {
    "mpjpe_ra_r": 9.0,
    "mpjpe_ra_l": 8.0,
    "cd_r_sq": 1.5,
    "cd_l_sq": 2.5,
    "cd_icp_sq": 0.5,
    "f10_icp": 97.5,
}


def idle_switch(config: RunConfig) -> str:
    """A switch of something that a plan has not."""
    return next(name for name in SWITCHES if without(config, name) == config)


class FakeRuns:
    """Writes what a run leaves behind, and remembers the folders' names.

    CD_r is an eighth of the length of the folder's name.
    """

    def __init__(self) -> None:
        self.made: list[str] = []
        self.fail: str | None = None

    def __call__(
        self,
        clip: Path,
        out: Path,
        config: RunConfig,
        *,
        hand_model: Path | None,
        ground_truth: Path | None,
        resume: bool,
        listen: Callable[[Mapping[str, Any]], None],
        observe: Observer | None,
    ) -> None:
        assert resume == (out / CONFIG).exists()
        self.made.append(out.name)
        out.mkdir(exist_ok=True)
        save_config(out / CONFIG, resolve(config).config, run_origin(clip, hand_model))
        listen({"event": "stage", "stage": "joint", "index": 0, "stages": 1})
        listen({"event": "step", "stage": "joint", "step": 1, "steps": 2, "seconds": 0.5})
        if out.name == self.fail:
            (out / CHECKPOINTS).mkdir()
            raise FloatingPointError("stage joint, step 1: image is not finite")
        (out / LOG).write_text(
            '{"event": "skipped", "text": "joint: 1 of 2 steps, the loss had settled (0.4 s saved)"}\n'
        )
        write_json(out / METRICS, {"initial": SCORES, "result": SCORES | {"cd_r_sq": len(out.name) / 8}})
