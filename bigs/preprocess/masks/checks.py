"""What looks wrong in a clip's masks: missing things, flicker, crumbs, pixels claimed twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.ndimage

from bigs.checks import InputError
from bigs.preprocess.frames.frame_ranges import frame_ranges
from bigs.types import ENTITIES, MASK_VALUES

# An area that differs by this factor from the median of the frames around it flickers.
_JUMP = 1.8
_AROUND = 3
# A mask in more pieces than a hand cut by fingers is torn.
_PIECES = 6
_CRUMB = 0.002  # pieces below this share of the entity's area are specks, not pieces
# Share of the masks' pixels that two entities claim.
_TWICE = 0.02


def check_masks(masks: Sequence[np.ndarray], twice: Sequence[int], names: Sequence[str]) -> list[str]:
    """Look at the label images of a clip.

    Args:
        masks: T images [H, W] uint8 with the values of `bigs.types.MASK_VALUES`.
        twice: T numbers of pixels that two entities claimed.
        names: T frame names.

    Returns:
        A sentence for each thing that a user should look at.

    Raises:
        InputError: no mask shows the object, or none shows a hand: there is nothing to reconstruct.
    """
    areas = {entity: np.array([(m == MASK_VALUES[entity]).sum() for m in masks]) for entity in ENTITIES}
    shown = ", ".join(f"{entity} in {(area > 0).sum()}" for entity, area in areas.items())
    if not areas["object"].any():
        raise InputError(
            f"masks: expected an object in the video, found no object pixel in any of {len(masks)} frames "
            f"({shown}); give masks that show what the hands hold"
        )
    if not areas["right"].any() and not areas["left"].any():
        raise InputError(
            "masks: expected a hand in the video, "
            f"found no pixel of either hand in any of {len(masks)} frames"
        )
    notes: list[str] = []
    for entity, area in areas.items():
        if not area.any():
            notes.append(f"{entity}: in no mask")
            continue
        if (area == 0).any():
            notes.append(f"{entity}: empty in {frame_ranges(area == 0)}")
        jumps = _flicker(area)
        if jumps.any():
            notes.append(f"{entity}: area jumps in {frame_ranges(jumps)}")
        torn = np.array([_pieces(mask == MASK_VALUES[entity]) > _PIECES for mask in masks])
        if torn.any():
            notes.append(f"{entity}: in more than {_PIECES} pieces in {frame_ranges(torn)}")
    claimed = sum(areas.values())
    share = np.asarray(twice) / np.maximum(claimed, 1)
    if (share > _TWICE).any():
        notes.append(
            f"overlaps: up to {100 * share.max():.0f} % of the pixels are claimed twice in "
            f"{frame_ranges(share > _TWICE)}; the object wins, then the left hand"
        )
    return notes


def _flicker(area: np.ndarray) -> np.ndarray:
    """Frames [T] (bool) whose area jumps against both the median before and the median after."""
    found = np.zeros(len(area), dtype=bool)
    for t in range(1, len(area) - 1):
        if not area[t]:
            continue
        ratios = []
        for near in (area[max(0, t - _AROUND) : t], area[t + 1 : t + 1 + _AROUND]):
            middle = float(np.median(near))
            ratios.append(np.inf if middle == 0 else max(area[t] / middle, middle / area[t]))
        found[t] = min(ratios) > _JUMP
    return found


def _pieces(mask: np.ndarray) -> int:
    """How many connected pieces, without specks."""
    labels, _ = scipy.ndimage.label(mask, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    return int((sizes > max(4.0, _CRUMB * sizes.sum())).sum()) if len(sizes) else 0
