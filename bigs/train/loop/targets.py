"""Images and masks at the resolution and crop of a stage."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from bigs.data.base import Clip
from bigs.threads import side_by_side
from bigs.types import ENTITIES, MASK_VALUES, Entity


@dataclass(frozen=True)
class Targets:
    """Images and masks of a whole clip, cropped to where anything ever is, and scaled."""

    images: Tensor  # [T, H, W, 3] in [0, 1]
    shares: dict[Entity, Tensor]  # [T, H, W] share of each pixel that shows the entity
    unknown: Tensor  # [T, H, W] share of each pixel in which an unlabelled occluder may hide a subject
    K: Tensor  # [3, 3] intrinsics of the crop
    width: int
    height: int

    def size(self) -> int:
        """Bytes, with what is derived from them."""
        return self.images.nbytes + 2 * sum(share.nbytes for share in (*self.shares.values(), self.unknown))

    @cached_property
    def foreground(self) -> Tensor:
        """Share of each pixel that shows any entity: [T, H, W]."""
        return sum(self.shares.values(), torch.zeros(())).clamp(max=1.0)

    @cached_property
    def hidden(self) -> dict[Entity, Tensor]:
        """Share of each pixel in which something else may hide an entity: [T, H, W]."""
        return {
            entity: sum(
                (share for other, share in self.shares.items() if other != entity), self.unknown
            ).clamp(max=1.0)
            for entity in self.shares
        }


def crop_box(clip: Clip, margin: float = 0.06) -> tuple[int, int, int, int]:
    """The box (x0, y0, x1, y1) in pixels that holds every entity in every frame, with a margin.

    A clip without any mask pixel is not cropped.
    """
    anything = np.zeros((clip.height, clip.width), dtype=bool)
    for t in range(len(clip)):
        anything |= clip.mask(t) != 0
    if not anything.any():
        return 0, 0, clip.width, clip.height
    rows, columns = np.flatnonzero(anything.any(1)), np.flatnonzero(anything.any(0))
    pad = int(np.ceil(margin * max(clip.width, clip.height)))
    return (
        max(int(columns[0]) - pad, 0),
        max(int(rows[0]) - pad, 0),
        min(int(columns[-1]) + 1 + pad, clip.width),
        min(int(rows[-1]) + 1 + pad, clip.height),
    )


def load_targets(
    clip: Clip,
    unknown: np.ndarray,
    scale: float,
    box: tuple[int, int, int, int],
    threads: int | None = None,
) -> Targets:
    """Read the clip's frames inside `box` and shrink them by area to `scale` times their size.

    `unknown` [T, H, W] (bool) marks unlabelled occluders at the clip's size. `threads` is as in
    `side_by_side`.
    """
    x0, y0, x1, y1 = box
    width, height = (max(1, round(scale * n)) for n in (x1 - x0, y1 - y0))
    images = torch.empty(len(clip), height, width, 3)
    present = [entity for entity in ENTITIES if entity in clip.hands or (entity == "object" and clip.object)]
    shares = {entity: torch.empty(len(clip), height, width) for entity in present}
    covered = torch.empty(len(clip), height, width)

    # Frame by frame into its place: a whole clip at full size, or twice, would be the run's largest array.
    def fill(t: int) -> None:
        image = torch.from_numpy(clip.image(t)[y0:y1, x0:x1]).permute(2, 0, 1)[None]
        images[t] = _shrunk(image.float() / 255.0, height, width)[0].permute(1, 2, 0)
        labels = clip.mask(t)[y0:y1, x0:x1]
        for entity in present:
            shares[entity][t] = share_per_pixel(labels == MASK_VALUES[entity], height, width)
        covered[t] = share_per_pixel(unknown[t, y0:y1, x0:x1], height, width)

    side_by_side(fill, range(len(clip)), threads)
    # Pixel centres lie at +0.5, so image coordinates scale without an offset.
    sx, sy = width / (x1 - x0), height / (y1 - y0)
    K = clip.K.copy()
    K[0] *= sx
    K[1] *= sy
    K[0, 2] -= sx * x0
    K[1, 2] -= sy * y0
    return Targets(
        images,
        shares,
        covered,
        torch.as_tensor(K, dtype=torch.float32),
        width,
        height,
    )


def share_per_pixel(mask: np.ndarray, height: int, width: int) -> Tensor:
    """A mask [H, W] (bool) as shares [height, width] of smaller pixels."""
    return _shrunk(torch.from_numpy(mask)[None, None].float(), height, width)[0, 0]


def _shrunk(picture: Tensor, height: int, width: int) -> Tensor:
    """A picture [1, C, H, W] as means over the pixels of a smaller one [1, C, height, width]."""
    return torch.nn.functional.interpolate(picture, (height, width), mode="bilinear", antialias=True)
