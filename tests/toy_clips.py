"""Clips painted by hand: images and masks as arrays, with as little else as a `Clip` can have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.types import ENTITIES, MASK_VALUES


def painted_clip(folder: Path, images: np.ndarray, masks: np.ndarray, K: np.ndarray | None = None) -> Clip:
    """A clip of images [T, H, W, 3] and masks [T, H, W] (uint8), with still poses for what is labelled."""
    frames, height, width = masks.shape
    paths: dict[str, list[Path]] = {"image": [], "mask": []}
    for kind, arrays in (("image", images), ("mask", masks)):
        (folder / kind).mkdir(parents=True)
        for t, array in enumerate(arrays):
            paths[kind].append(folder / kind / f"{t:04d}.png")
            Image.fromarray(array).save(paths[kind][-1])
    areas = {entity: (masks == MASK_VALUES[entity]).sum((1, 2)) for entity in ENTITIES}
    hand = HandTrack(
        np.zeros((frames, 3)),
        np.zeros((frames, 15, 3)),
        np.zeros((frames, 3)),
        np.zeros(10),
        np.ones(frames, dtype=bool),
    )
    obj = ObjectTrack(
        np.eye(3),
        None,
        1.0,
        np.eye(4),
        np.broadcast_to(np.eye(3), (frames, 3, 3)),
        np.zeros((frames, 3)),
        hand.valid,
    )
    return Clip(
        name="painted",
        folder=folder,
        frame_names=tuple(f"{t:04d}.png" for t in range(frames)),
        image_paths=tuple(paths["image"]),
        mask_paths=tuple(paths["mask"]),
        width=width,
        height=height,
        K=np.array([[100.0, 0.0, width / 2], [0.0, 100.0, height / 2], [0.0, 0.0, 1.0]]) if K is None else K,
        cam_from_world=np.broadcast_to(np.eye(4), (frames, 4, 4)),
        hands={side: hand for side in ("right", "left") if areas[side].any()},
        object=obj if areas["object"].any() else None,
        scene_scale=1.0,
        normalize_shift=np.zeros(3),
        mask_areas=areas,
    )
