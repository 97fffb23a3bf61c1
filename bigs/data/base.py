"""A loaded clip: paths, camera, and per-frame initial estimates. Numpy, metres, radians.

A clip's world is whatever the dataset chose; `cam_from_world` leads to the OpenCV camera of each frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bigs.data.decoded import DecodedFrames
from bigs.data.optics import Optics
from bigs.names import check_name
from bigs.types import MASK_VALUES, USUAL_FPS, Entity, Side

# Every label with the hands' exchanged.
_EXCHANGED = np.arange(256, dtype=np.uint8)
_EXCHANGED[[MASK_VALUES["right"], MASK_VALUES["left"]]] = MASK_VALUES["left"], MASK_VALUES["right"]


@dataclass(frozen=True)
class HandTrack:
    """One hand over the clip, in the clip's world, in that side's own MANO convention (nothing is mirrored).

    `x_world = MANO(global_orient, hand_pose, betas) + transl`, where MANO turns about its rest wrist joint.
    """

    global_orient: np.ndarray  # [T, 3] axis-angle
    hand_pose: np.ndarray  # [T, 15, 3] axis-angle relative to the model's hands_mean
    transl: np.ndarray  # [T, 3] metres
    betas: np.ndarray  # [10]
    valid: np.ndarray  # [T] bool: there is an estimate; the others are filled from their neighbours


@dataclass(frozen=True)
class ObjectTrack:
    """The object over the clip: `x_world = rotations (metric_from_canon x_canon) + transl`."""

    points: np.ndarray  # [N, 3] canonical points as stored
    colors: np.ndarray | None  # [N, 3] in [0, 1]; None when the file has none
    scale: float  # metres per unit of the frame the points were reconstructed in
    metric_from_canon: np.ndarray  # [4, 4]: diag(scale, scale, scale, 1) @ inv(norm_mat)
    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3] metres
    valid: np.ndarray  # [T] bool: there is an estimate; the others are filled from their neighbours

    def middle(self) -> np.ndarray:
        """The middle of the points in the object's own metric frame, [3]."""
        middle = np.median(self.points, axis=0)
        return self.metric_from_canon[:3, :3] @ middle + self.metric_from_canon[:3, 3]

    def points_world(self) -> np.ndarray:
        """The points in every frame, [T, N, 3] metres, world."""
        metric = self.points @ self.metric_from_canon[:3, :3].T + self.metric_from_canon[:3, 3]
        return np.einsum("tij,nj->tni", self.rotations, metric) + self.transl[:, None]


@dataclass(frozen=True)
class Clip:
    """A monocular clip with its initial estimates, or with a dataset's annotation in their place.

    Raises:
        InputError: a name that could not name a file.
    """

    name: str  # names files; see `bigs.names.check_name`
    folder: Path  # where image/, mask/ and data.npy lie
    frame_names: tuple[str, ...]  # T original names
    image_paths: tuple[Path, ...]
    mask_paths: tuple[Path, ...]  # empty for a data set's sequence without masks
    width: int
    height: int
    K: np.ndarray  # [3, 3]; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)
    cam_from_world: np.ndarray  # [T, 4, 4] rigid, OpenCV camera axes
    hands: dict[Side, HandTrack]
    object: ObjectTrack | None
    scene_scale: float  # the space HOLD trains in is scene_scale * world
    normalize_shift: (
        np.ndarray
    )  # [3] metres: x_world = diag(1, -1, -1) x_cam + normalize_shift in HOLD's files
    mask_areas: dict[Entity, np.ndarray]  # [T] pixels of each entity in the mask files, for every entity
    fps: float = USUAL_FPS  # frames a second
    pace: float | None = None  # the rate at which things usually move as here, if clearly slower (see `pace`)
    annotated: bool = False  # the tracks are a data set's truth; no reconstruction may start from them
    optics: Optics | None = None  # how the files differ from pinhole images, if they do
    swapped: np.ndarray | None = None  # [T] bool: the mask files call the right hand left, and the left right
    # Lines [T, 3] across the wrists of hands whose masks go on over the arm (see `forearms`).
    arms: Mapping[Side, np.ndarray] | None = None
    gains: np.ndarray | None = None  # [T, 3] how many times as bright as usual the files' channels are
    # The files show black + brightness * what `image` does, in [0, 1] (see `bigs.data.oddities.brightness`).
    black: float = 0.0
    brightness: float = 1.0
    notes: tuple[str, ...] = ()  # what was odd in the estimates or was taken out (see `plausible`)
    # The frames that were read so far.
    decoded: DecodedFrames = field(default_factory=DecodedFrames, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_name(f"{self.folder}: name", self.name)

    def __len__(self) -> int:
        return len(self.image_paths)

    def image(self, t: int) -> np.ndarray:
        """Frame `t`, [H, W, 3] uint8 RGB, in the clip's usual exposure."""
        gain = np.ones(3) if self.gains is None else self.gains[t]
        return self._shown(t, gain)

    def image_as_taken(self, t: int) -> np.ndarray:
        """Frame `t`, [H, W, 3] uint8 RGB, in its own exposure."""
        return self._shown(t, np.ones(3))

    def _shown(self, t: int, gain: np.ndarray) -> np.ndarray:
        """Frame `t` as if it had been taken with a gain [3] of one, and with the usual black and white."""
        image = self._pinhole_image(t)
        if (gain == 1.0).all() and (self.black, self.brightness) == (0.0, 1.0):
            return image
        levels = (np.arange(256)[:, None] / gain - 255.0 * self.black) / self.brightness
        table = levels.round().clip(0, 255).astype(np.uint8)
        return np.stack([table[image[..., channel], channel] for channel in range(3)], axis=-1)

    def _pinhole_image(self, t: int) -> np.ndarray:
        if self.optics is None:
            return self.decoded.image(self.image_paths[t], (self.width, self.height))
        return self.optics.pinhole(t, self.decoded.image(self.image_paths[t], self.optics.file_size), order=1)

    def mask(self, t: int) -> np.ndarray:
        """Labels of frame `t`, [H, W] uint8: 0 or one of `bigs.types.MASK_VALUES`. Arms are background."""
        labels = self.mask_with_arms(t)
        return labels if self.arms is None else np.where(self._arm(t, labels), np.uint8(0), labels)

    def arm(self, t: int) -> np.ndarray:
        """Where the masks of frame `t` call an arm a hand, [H, W] bool."""
        return self._arm(t, self.mask_with_arms(t))

    def _arm(self, t: int, labels: np.ndarray) -> np.ndarray:
        found = np.zeros(labels.shape, dtype=bool)
        for side, lines in (self.arms or {}).items():
            found |= beyond_line(lines[t], labels.shape) & (labels == MASK_VALUES[side])
        return found

    def mask_with_arms(self, t: int) -> np.ndarray:
        """Labels of frame `t`, [H, W] uint8, in which arms belong to hands wherever the files say so."""
        if self.optics is None:
            labels = self.decoded.mask(self.mask_paths[t], (self.width, self.height))
        else:
            labels = self.optics.pinhole(
                t, self.decoded.mask(self.mask_paths[t], self.optics.file_size), order=0
            )
        return _EXCHANGED[labels] if self.swapped is not None and self.swapped[t] else labels

    def has_pixels(self, entity: Entity) -> np.ndarray:
        """In which frames the masks show `entity`, [T] bool."""
        return self.mask_areas[entity] > 0


def beyond_line(line: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which pixels (x, y) of an image of that shape have a x + b y + c > 0, bool [H, W], for a line [3]."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    a, b, c = line
    return a * (columns + 0.5) + b * (rows + 0.5) + c > 0.0
