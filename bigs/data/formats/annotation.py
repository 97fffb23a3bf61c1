"""A data set's annotation of a sequence: poses in its own world, cameras, and the object's mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bigs.data.base import Clip, HandTrack, ObjectTrack
from bigs.data.decoded import DecodedFrames
from bigs.data.formats.hold import RADIUS_PER_SHIFT, shift_before
from bigs.data.optics import Optics
from bigs.types import Side


@dataclass(frozen=True)
class ObjectTruth:
    """The true object over a sequence: `x_world = rotations x + transl` for the vertices x of its mesh."""

    verts: np.ndarray  # [V, 3] metres, or [T, V, 3] where it bends
    faces: np.ndarray  # [F, 3]
    rotations: np.ndarray  # [T, 3, 3]
    transl: np.ndarray  # [T, 3] metres
    valid: np.ndarray  # [T] bool: annotated; the others are filled from their neighbours

    def verts_world(self) -> np.ndarray:
        """The vertices in every frame, [T, V, 3] metres, world."""
        verts = np.broadcast_to(self.verts, (len(self.transl), *self.verts.shape[-2:]))
        return np.einsum("tij,tnj->tni", self.rotations, verts) + self.transl[:, None]


@dataclass(frozen=True)
class Annotation:
    """A sequence as its dataset annotates it, seen by one camera."""

    name: str
    frame_names: tuple[str, ...]  # T names of images
    width: int
    height: int
    K: np.ndarray  # [3, 3]
    cam_from_world: np.ndarray  # [T, 4, 4] rigid, OpenCV camera axes
    hands: dict[Side, HandTrack]  # in the world
    object: ObjectTruth | None

    def __len__(self) -> int:
        return len(self.frame_names)


def annotated_clip(
    annotation: Annotation,
    folder: Path,
    image_paths: tuple[Path, ...],
    mask_paths: tuple[Path, ...],
    optics: Optics | None = None,
) -> Clip:
    """A clip whose tracks are the annotation; the object's points are its mesh's vertices.

    Args:
        annotation: of the frames that the images show.
        folder: what the clip is called by in messages.
        image_paths: T images.
        mask_paths: T label masks, or none.
        optics: how the files differ from the annotation's pictures, where they do.

    Raises:
        InputError: an image or a mask is unreadable or has another size than it should.
    """
    size = (annotation.width, annotation.height) if optics is None else optics.file_size
    decoded = DecodedFrames()
    areas = decoded.read_all(image_paths, mask_paths, size)
    obj = None
    if annotation.object is not None:
        truth = annotation.object
        obj = ObjectTrack(
            points=truth.verts if truth.verts.ndim == 2 else truth.verts[0],
            colors=None,
            scale=1.0,
            metric_from_canon=np.eye(4),
            rotations=truth.rotations,
            transl=truth.transl,
            valid=truth.valid,
        )
    positions = obj.points_world().mean(axis=1) if obj is not None else _hand_positions(annotation)
    to_cam = annotation.cam_from_world
    in_camera = np.einsum("tij,tj->ti", to_cam[:, :3, :3], positions) + to_cam[:, :3, 3]
    shift = shift_before(np.median(in_camera, axis=0))
    return Clip(
        name=annotation.name,
        folder=folder,
        frame_names=annotation.frame_names,
        image_paths=image_paths,
        mask_paths=mask_paths,
        width=annotation.width,
        height=annotation.height,
        K=annotation.K,
        cam_from_world=to_cam,
        hands=annotation.hands,
        object=obj,
        scene_scale=1.0 / (RADIUS_PER_SHIFT * float(np.linalg.norm(shift))),
        normalize_shift=shift,
        mask_areas=areas,
        decoded=decoded,
        annotated=True,
        optics=optics,
    )


def _hand_positions(annotation: Annotation) -> np.ndarray:
    return np.mean([track.transl for track in annotation.hands.values()], axis=0)
