"""Scores of a finished run."""

from __future__ import annotations

import json
from pathlib import Path

from bigs.commands.run_folder import METRICS, load_run, write_json
from bigs.data.ground_truth import load_ground_truth
from bigs.metrics.report import comparison_table, evaluate


def evaluate_run(run: Path, ground_truth: Path) -> list[tuple[str, ...]]:
    """Score a run, write `metrics.json`, and return the table; scores of the initial estimates stay beside.

    Raises:
        InputError: the run or the truth is not as it should be, or they list different frames.
    """
    playback = load_run(run)
    result = evaluate(playback.trajectory(), load_ground_truth(ground_truth))
    path = run / METRICS
    scores = json.loads(path.read_text()) if path.exists() else {}
    scores["result"] = scores.get("result", {}) | result
    write_json(path, scores)
    return comparison_table(scores)
