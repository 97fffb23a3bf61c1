"""Image scores of a reconstruction: on the clip's own frames and in held-out views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from bigs.commands.render.frame import render_frame, render_input_view
from bigs.data.base import Clip
from bigs.data.novel import load_novel_views
from bigs.metrics.picture import ALIGNED, NOVEL, NOVEL_SCALED, Distance, aligned_psnr, picture_scores
from bigs.models.playback import Playback
from bigs.threads import side_by_side
from bigs.types import MASK_VALUES

# Frames that are rendered and compared at once, at most.
_AT_ONCE = 4


def frame_scores(
    clip: Clip,
    playback: Playback,
    distance: Distance | None = None,
    at: Sequence[int] | np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Image scores of every frame of the clip, by key, [T]; NaN where the mask is empty.

    Args:
        clip: the clip, or some of its frames.
        playback: the reconstruction.
        distance: see `picture_scores`.
        at: [T] the playback's frames that show the clip's; None takes all in their order.
    """
    frames = range(len(clip)) if at is None else at

    def scores(t: int) -> dict[str, float]:
        color, _ = render_input_view(playback, int(frames[t]))
        return picture_scores(color, clip.image(t) / 255.0, clip.mask(t) != 0, distance)

    # A frame alone is too small to keep several threads at work, and more frames at once take memory.
    rows = side_by_side(scores, range(len(frames)), min(torch.get_num_threads(), _AT_ONCE))
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def novel_scores(
    playback: Playback, folder: Path, distance: Distance | None = None, scale: float | None = None
) -> dict[str, float]:
    """Mean image scores of held-out views, under the keys of novel views.

    Args:
        playback: the reconstruction.
        folder: see `load_novel_views`.
        distance: see `picture_scores`.
        scale: what the clip is multiplied by, about its camera's centre, to be as large as the truth; None
            gives no scores of the scaled clip.

    Raises:
        InputError: the views are not as they should be.
    """
    views = load_novel_views(folder, len(playback))
    sizes = {NOVEL: 1.0} if scale is None else {NOVEL: 1.0, NOVEL_SCALED: scale}
    scores: dict[str, float] = {}
    for prefix, size in sizes.items():
        rows = []
        for view in views:
            viewmat, K = (torch.tensor(matrix, dtype=torch.float32) for matrix in (view.viewmat, view.K))
            # A larger clip looks the same as a nearer camera.
            viewmat[:3, 3] /= size
            camera = (view.frame_index, viewmat, K, *view.size)
            image, labels = view.image() / 255.0, view.mask()
            color, _ = render_frame(playback, *camera)
            alone = {entity: render_frame(playback, *camera, [entity])[0] for entity in playback.entities}
            masks: dict[str, np.ndarray] = {entity: labels == value for entity, value in MASK_VALUES.items()}
            # A subject that was not reconstructed renders as nothing.
            renders: dict[str, np.ndarray] = {
                entity: alone.get(entity, np.zeros_like(color)) for entity in MASK_VALUES
            }
            scores_here = picture_scores(color, image, labels != 0, distance)
            rows.append(scores_here | {ALIGNED: aligned_psnr(renders, image, masks)})
        columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
        scores |= {f"{prefix}{key}": value for key, value in means(columns).items()}
    return scores


def partly(columns: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Of scores that not every frame has, over how many frames `means` takes them, by key."""
    counts = {key: (int(np.isfinite(values).sum()), len(values)) for key, values in columns.items()}
    return {key: f"{count} of {whole} frames" for key, (count, whole) in counts.items() if count < whole}


def means(columns: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The mean of each column over the frames that have it; columns without any are left out."""
    finite = {key: values[np.isfinite(values)] for key, values in columns.items()}
    return {key: float(values.mean()) for key, values in finite.items() if len(values)}
