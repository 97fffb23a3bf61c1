"""Pictures of the object alone, cut from a clip's frames: what a token is learned from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from bigs.checks import InputError
from bigs.geometry.spread import spread

# Sides of a crop relative to the object's box; a step draws one, so that size is not learned.
ZOOMS = (1.1, 1.6)
# A mask with fewer pixels shows nothing; one far smaller than the clip's largest shows too little of the
# object.
_LEAST_PIXELS, _LEAST_SHARE = 64, 0.25


class Crop(NamedTuple):
    """A square around the object, `ZOOMS[1]` times its box, centred on it."""

    picture: Tensor  # [3, S, S] uint8; the object on white, without its surroundings
    mask: Tensor  # [1, S, S] uint8, 255 on the object


def choose_frames(where: str, areas: np.ndarray, most: int) -> list[int]:
    """Up to `most` frames, spread evenly over those that show enough of the object.

    Args:
        where: what to call the clip in messages.
        areas: of the object's masks, [T] pixels.
        most: how many.

    Raises:
        InputError: no frame does.
    """
    shown = np.flatnonzero(areas >= max(_LEAST_PIXELS, _LEAST_SHARE * areas.max(initial=0)))
    if not len(shown):
        raise InputError(
            f"{where}: masks: expected a frame with at least {_LEAST_PIXELS} pixels of the object, "
            f"found at most {int(areas.max(initial=0))}"
        )
    return [int(frame) for frame in shown[spread(len(shown), most)]]


def cut_crop(image: np.ndarray, mask: np.ndarray, size: int) -> Crop:
    """Cut the object out of a frame.

    Args:
        image: [H, W, 3] uint8.
        mask: [H, W] bool, with at least one true pixel.
        size: the crop is made no larger than steps at this size can use.
    """
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    box = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    side = int(np.ceil(ZOOMS[1] * box))
    top, left = (int((line[0] + line[-1] + 1 - side) // 2) for line in (rows, columns))
    inside = slice(max(top, 0), top + side), slice(max(left, 0), left + side)
    place = image[inside].shape[:2]
    first = max(-top, 0), max(-left, 0)
    into = slice(first[0], first[0] + place[0]), slice(first[1], first[1] + place[1])
    picture, alone = np.full((side, side, 3), 255, np.uint8), np.zeros((side, side), np.uint8)
    alone[into] = 255 * mask[inside].astype(np.uint8)
    picture[into] = np.where(mask[inside][..., None], image[inside], 255)
    crop = Crop(torch.from_numpy(picture).permute(2, 0, 1), torch.from_numpy(alone)[None])
    most = int(np.ceil(size * ZOOMS[1] / ZOOMS[0]))
    return Crop(*(_resized(part, most).round().to(torch.uint8) for part in crop)) if side > most else crop


def draw_pictures(
    crops: list[Crop], count: int, size: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Random crops at random zooms.

    Returns:
        Pictures [count, 3, size, size] in [0, 1]; how much of each pixel is object, [count, 1, size, size].
    """
    pictures, shares = [], []
    for _ in range(count):
        crop = crops[int(torch.randint(len(crops), (), generator=generator))]
        whole = crop.mask.shape[-1]
        zoom = float(torch.empty(()).uniform_(ZOOMS[0], ZOOMS[1], generator=generator))
        side = max(1, round(whole * zoom / ZOOMS[1]))
        # The object's box fills 1 / zoom of the side and is moved as far as it stays inside.
        reach = max(0.0, (side - whole / ZOOMS[1]) / 2.0)
        moves = (2.0 * torch.rand(2, generator=generator) - 1.0) * reach
        top, left = (min(max(round((whole - side) / 2 + float(m)), 0), whole - side) for m in moves)
        place = (..., slice(top, top + side), slice(left, left + side))
        pictures.append(_resized(crop.picture[place], size) / 255.0)
        shares.append(_resized(crop.mask[place], size) / 255.0)
    return torch.stack(pictures), torch.stack(shares)


def _resized(values: Tensor, size: int) -> Tensor:
    """[C, S, S] to [C, size, size], float."""
    return interpolate(values[None].float(), (size, size), mode="bilinear", antialias=True)[0].clamp(
        0.0, 255.0
    )
