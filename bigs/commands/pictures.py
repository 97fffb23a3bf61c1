"""How a reconstruction's pictures score: on the clip's own frames, and from views held back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from bigs.commands.rendering import render_frame, render_input_view
from bigs.data.base import Clip
from bigs.data.novel import load_novel_views
from bigs.metrics.picture import NOVEL, Distance, picture_scores
from bigs.models.playback import Playback


def frame_scores(clip: Clip, playback: Playback, distance: Distance | None = None) -> dict[str, np.ndarray]:
    """Image scores of every frame of the clip, by key, [T]; NaN where the mask is empty."""
    rows = []
    for t in range(len(clip)):
        color, _ = render_input_view(playback, t)
        rows.append(picture_scores(color, clip.image(t) / 255.0, clip.mask(t) != 0, distance))
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def novel_scores(playback: Playback, folder: Path, distance: Distance | None = None) -> dict[str, float]:
    """Mean image scores of held-back views, under the keys of novel views.

    Raises:
        InputError: the views are not as they should be.
    """
    rows = []
    for view in load_novel_views(folder, len(playback)):
        viewmat, K = (torch.as_tensor(matrix, dtype=torch.float32) for matrix in (view.viewmat, view.K))
        color, _ = render_frame(playback, view.frame_index, viewmat, K, *view.size)
        rows.append(picture_scores(color, view.image() / 255.0, view.mask() != 0, distance))
    return {
        f"{NOVEL}{key}": value
        for key, value in means({key: np.array([row[key] for row in rows]) for key in rows[0]}).items()
    }


def means(columns: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The mean of each column over the frames that have it; columns without any are left out."""
    finite = {key: values[np.isfinite(values)] for key, values in columns.items()}
    return {key: float(values.mean()) for key, values in finite.items() if len(values)}
