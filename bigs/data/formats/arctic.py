"""ARCTIC's raw release: raw_seqs/, meta/, images/; poses of both hands and of an articulated object.

World axes are the motion capture's, metres. Annotation row of an image: its number minus the subject's
`ioi_offset`. A sequence seen by one camera is named ROOT/images/SUBJECT/SEQUENCE/VIEW, and ROOT is the folder
that holds raw_seqs/ and meta/. Views 1 to 8 stand still; view 0 is the egocentric camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.checks import InputError, check_pixels, check_product
from bigs.data.base import Clip, HandTrack
from bigs.data.entries import array_entry, flat_entry, mapping_entry, require
from bigs.data.formats.annotation import Annotation, ObjectTruth, annotated_clip
from bigs.data.images import IMAGE_SUFFIXES, MASK_SUFFIXES, check_pairs, list_frames, read_image
from bigs.data.meshes import LONGEST_M, check_solid, read_mesh
from bigs.data.optics import Optics
from bigs.data.tracks import check_turns
from bigs.files import read_json
from bigs.names import check_name
from bigs.types import SIDES
from bigs.unpickle import load_npy

# The paper's camera.
DEFAULT_VIEW = 1
MM_PER_M = 1000.0
_IMAGE_FOLDERS = ("images", "cropped_images")
# ARCTIC's own processing writes a sequence into one of these folders below ROOT; it has the boxes.
_PROCESSED_FOLDERS = ("processed/seqs", "processed_verts/seqs")
# A cropped image shows this many times the box, whose side is its scale times this many pixels.
_CROP_FACTOR, _BOX_PIXELS = 1.5, 200.0
# Our addition: label masks may lie here, in the same tree as the images.
_MASK_FOLDER = "masks"


class ArcticView(NamedTuple):
    """A sequence of the release as one camera sees it."""

    root: Path
    subject: str  # such as s05
    sequence: str  # such as box_grab_01
    view: int

    @property
    def name(self) -> str:
        """As HOLD and the HANDS challenge name such a clip."""
        return f"arctic_{self.subject}_{self.sequence}_{self.view}"

    @property
    def object_name(self) -> str:
        """The object's name, with which a sequence's begins."""
        return self.sequence.split("_")[0]

    def raw(self, kind: str) -> Path:
        """The file of annotations of a kind: mano, object or egocam.dist."""
        return self.root / "raw_seqs" / self.subject / f"{self.sequence}.{kind}.npy"

    def frames_in(self, tree: str) -> Path:
        """The view's folder below `tree`: images, cropped_images or masks."""
        return self.root / tree / self.subject / self.sequence / str(self.view)


def find_arctic(path: str | Path) -> ArcticView | None:
    """The view that a path names, or None where no folder on the way up is ARCTIC's.

    Args:
        path: ROOT, ROOT/SUBJECT/SEQUENCE or ROOT/SUBJECT/SEQUENCE/VIEW, with images/, cropped_images/ or
            raw_seqs/ after ROOT or without; it need not exist below ROOT. The view is 1 if not given.

    Raises:
        InputError: the release has no such sequence, or several and the path names none.
    """
    path = Path(path)
    absolute = path.absolute()
    root = next(
        (p for p in (absolute, *absolute.parents) if (p / "raw_seqs").is_dir() and (p / "meta").is_dir()),
        None,
    )
    if root is None:
        return None
    parts = [*absolute.relative_to(root).parts]
    if parts and parts[0] in (*_IMAGE_FOLDERS, "raw_seqs"):
        parts = parts[1:]
    known = sorted(
        (file.parent.name, file.name.removesuffix(".mano.npy")) for file in root.glob("raw_seqs/*/*.mano.npy")
    )
    wanted = (*parts[:1], *(part.split(".")[0] for part in parts[1:2]))
    matches = [pair for pair in known if pair[: len(wanted)] == wanted]
    if len(matches) != 1:
        examples = ", ".join("/".join(pair) for pair in (matches or known)[:4]) or "none"
        raise InputError(f"{path}: expected ROOT/SUBJECT/SEQUENCE/VIEW of ARCTIC, found sequences {examples}")
    view = parts[2] if len(parts) > 2 else str(DEFAULT_VIEW)
    if len(parts) > 3 or view not in "012345678":
        raise InputError(f"{path}: expected a view from 0 to 8 at the end, found {'/'.join(parts[2:])}")
    return ArcticView(root, *matches[0], int(view))


def load_arctic(path: str | Path) -> Clip:
    """A view's images with its annotation as tracks (`annotated` is set), and its masks where there are any.

    Cropped images are put back where they were cut out, and the egocentric view's distortion is undone.

    Raises:
        InputError: one sentence naming file, field, expected and found.
    """
    view = find_arctic(path)
    if view is None:
        raise InputError(f"{path}: expected a folder with raw_seqs/ and meta/ of ARCTIC, found none")
    folder = view.frames_in("images")
    if not folder.is_dir() and view.frames_in("cropped_images").is_dir():
        folder = view.frames_in("cropped_images")
    image_paths = list_frames(folder, IMAGE_SUFFIXES)
    mask_paths: tuple[Path, ...] = ()
    if view.frames_in(_MASK_FOLDER).is_dir():
        mask_paths = list_frames(view.frames_in(_MASK_FOLDER), MASK_SUFFIXES)
        check_pairs(image_paths, mask_paths)
    annotation = read_arctic(view, [file.name for file in image_paths])
    return annotated_clip(annotation, folder, image_paths, mask_paths, _optics(view, annotation, image_paths))


def read_arctic(view: ArcticView, frame_names: Sequence[str]) -> Annotation:
    """The annotation of some images; frames that the release does not annotate are not valid.

    Args:
        view: see `find_arctic`.
        frame_names: the images' names, whose stems are numbers.

    Raises:
        InputError: a missing or damaged file or field, a name that is no number, or no annotated frame.
    """
    where, meta = _subject_meta(view)
    width, height = _image_size(where, meta, view.view)
    hands_file = view.raw("mano")
    stored = mapping_entry(str(hands_file), load_npy(hands_file))
    where_hands = {side: f"{hands_file}: {side}" for side in SIDES}
    right = mapping_entry(where_hands["right"], stored.get("right", {}))
    where_rows = f"{where_hands['right']}.rot"
    n_rows = len(array_entry(where_rows, require(where_rows, right, "rot"), ("T", 3)))
    rows, offset = _rows(view, frame_names)
    valid = (rows >= 0) & (rows < n_rows)
    if not valid.any():
        raise InputError(
            f"{hands_file}: expected the images {frame_names[0]} to {frame_names[-1]} among its {n_rows} "
            f"frames from {offset} on, found none"
        )
    rows = np.clip(rows, 0, n_rows - 1)
    K, cam_from_world = _camera(view, where, meta, rows)
    return Annotation(
        name=check_name(f"{view.root}: sequence", view.name),
        frame_names=tuple(frame_names),
        width=width,
        height=height,
        K=K,
        cam_from_world=cam_from_world,
        hands={
            side: _read_hand(where_hands[side], require(where_hands[side], stored, side), n_rows, rows, valid)
            for side in SIDES
        },
        object=_read_object(view, n_rows, rows, valid),
    )


def meta_of_images(folder: Path) -> Path | None:
    """`ROOT/meta/misc.json` for a folder ROOT/images/SUBJECT/SEQUENCE/VIEW of whole images by a still camera.

    None for any other folder, or where the release's `meta` was not downloaded.
    """
    parts = folder.absolute().parts
    if len(parts) < 5 or parts[-4] != "images" or parts[-1] not in "12345678":
        return None
    file = Path(*parts[:-4]) / "meta" / "misc.json"
    return file if file.is_file() else None


def camera_of_images(folder: Path) -> tuple[np.ndarray, tuple[int, int]] | None:
    """K [3, 3] of a folder of ARCTIC's images, and the width and height that it belongs to.

    Needs no annotation. None where `meta_of_images` finds nothing.

    Raises:
        InputError: the file does not have the subject or its cameras.
    """
    file = meta_of_images(folder)
    if file is None:
        return None
    subject, sequence, view = folder.absolute().parts[-3:]
    where, meta = _subject_meta(ArcticView(file.parent.parent, subject, sequence, int(view)))
    return _intrinsics(where, meta)[int(view) - 1], _image_size(where, meta, int(view))


def _image_size(where: str, meta: Mapping[str, Any], view: int) -> tuple[int, int]:
    """Width and height of a view's whole pictures."""
    where = f"{where}.image_size"
    size = array_entry(where, require(where, meta, "image_size"), (9, 2))[view]
    if size.min() < 1 or (size != np.floor(size)).any():
        raise InputError(f"{where}: expected widths and heights in pixels, found {size.tolist()}")
    width, height = map(int, size)
    check_pixels(where, width, height)
    return width, height


def _intrinsics(where: str, meta: Mapping[str, Any]) -> np.ndarray:
    return array_entry(f"{where}.intris_mat", require(f"{where}.intris_mat", meta, "intris_mat"), (8, 3, 3))


def _subject_meta(view: ArcticView) -> tuple[str, Mapping[str, Any]]:
    """The subject's entry of misc.json, and its name in messages."""
    file = view.root / "meta" / "misc.json"
    where = f"{file}: {view.subject}"
    meta = mapping_entry(str(file), read_json(file))
    return where, mapping_entry(where, require(where, meta, view.subject))


def _rows(view: ArcticView, frame_names: Sequence[str]) -> tuple[np.ndarray, int]:
    """The annotation row of each image [T], which may not exist, and the number of the image of row 0."""
    where, meta = _subject_meta(view)
    offset = int(array_entry(f"{where}.ioi_offset", require(f"{where}.ioi_offset", meta, "ioi_offset"), ()))
    return np.array([_frame_number(view, name) for name in frame_names]) - offset, offset


def _frame_number(view: ArcticView, name: str) -> int:
    stem = Path(name).stem
    if not stem.isdecimal():
        raise InputError(f"{view.name}: expected frames named by number as ARCTIC's are, found {name!r}")
    return int(stem)


def _camera(
    view: ArcticView, where: str, meta: Mapping[str, Any], rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """K [3, 3] and cam_from_world [T, 4, 4] of the view."""
    if view.view == 0:
        return _egocentric_camera(view.raw("egocam.dist"), rows)
    intrinsics = _intrinsics(where, meta)
    world2cam = array_entry(f"{where}.world2cam", require(f"{where}.world2cam", meta, "world2cam"), (8, 4, 4))
    return intrinsics[view.view - 1], np.repeat(world2cam[view.view - 1][None], len(rows), axis=0)


def _egocentric_camera(file: Path, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    stored = mapping_entry(str(file), load_npy(file))

    def field(key: str, shape: tuple[int | str, ...]) -> np.ndarray:
        return array_entry(f"{file}: {key}", require(f"{file}: {key}", stored, key), shape)

    cam_from_world = np.repeat(np.eye(4)[None], len(rows), axis=0)
    cam_from_world[:, :3, :3] = field("R_k_cam_np", ("T", 3, 3))[rows]
    cam_from_world[:, :3, 3:] = field("T_k_cam_np", ("T", 3, 1))[rows]
    return field("intrinsics", (3, 3)), cam_from_world


def _optics(view: ArcticView, annotation: Annotation, image_paths: Sequence[Path]) -> Optics | None:
    """How the files differ from the view's pinhole pictures; None where they do not."""
    height, width = read_image(image_paths[0]).shape[:2]
    size = (annotation.width, annotation.height)
    distortion = np.zeros(8)
    if view.view == 0:
        file = view.raw("egocam.dist")
        stored = mapping_entry(str(file), load_npy(file))
        distortion = array_entry(f"{file}: dist8", stored.get("dist8", distortion), (8,))
    is_cropped = image_paths[0].is_relative_to(view.root / "cropped_images")
    boxes = np.repeat([[0.0, 0.0, *map(float, size)]], len(image_paths), axis=0)
    if not is_cropped or (width, height) == size:
        # An image of another size is refused when it is read.
        return Optics(annotation.K, size, size, boxes, distortion) if distortion.any() else None
    if view.view:  # those of view 0 are whole images at a smaller size
        boxes = _crop_boxes(view, [path.name for path in image_paths])
    return Optics(annotation.K, size, (width, height), boxes, distortion)


def _crop_boxes(view: ArcticView, frame_names: Sequence[str]) -> np.ndarray:
    """The part of the whole picture that each cropped image shows, [T, 4] left, top, right, bottom."""
    places = [view.root / place / view.subject / f"{view.sequence}.npy" for place in _PROCESSED_FOLDERS]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise InputError(
            f"{view.frames_in('images')}: expected the whole images, or in {places[0]} the boxes of the "
            "cropped ones, found only cropped_images"
        )
    stored = mapping_entry(str(file), load_npy(file))
    boxes = array_entry(f"{file}: bbox", require(f"{file}: bbox", stored, "bbox"), ("T", 9, 3))
    rows, _ = _rows(view, frame_names)
    center_x, center_y, scale = boxes[np.clip(rows, 0, len(boxes) - 1), view.view].T
    half = 0.5 * _CROP_FACTOR * _BOX_PIXELS * scale
    return np.stack([center_x - half, center_y - half, center_x + half, center_y + half], axis=-1)


def _read_hand(where: str, stored: Any, n_rows: int, rows: np.ndarray, valid: np.ndarray) -> HandTrack:
    stored = mapping_entry(where, stored)

    def field(key: str, shape: tuple[int, ...]) -> np.ndarray:
        return array_entry(f"{where}.{key}", require(f"{where}.{key}", stored, key), shape)

    # One shape for all frames; the documentation shows it repeated in every frame.
    shapes = flat_entry(f"{where}.shape", require(f"{where}.shape", stored, "shape"))
    betas = field("shape", (n_rows, 10))[0] if len(shapes) != 10 else shapes
    return HandTrack(
        global_orient=field("rot", (n_rows, 3))[rows],
        hand_pose=field("pose", (n_rows, 45))[rows].reshape(len(rows), 15, 3),
        transl=field("trans", (n_rows, 3))[rows],
        betas=betas,
        valid=valid,
    )


def _read_object(view: ArcticView, n_rows: int, rows: np.ndarray, valid: np.ndarray) -> ObjectTruth | None:
    """The template, bent and moved; None where the release's templates were not downloaded."""
    folder = view.root / "meta" / "object_vtemplates" / view.object_name
    if not folder.is_dir():
        return None
    verts, faces = read_mesh(folder / "mesh.obj")
    # Objects are between 2 mm and 2 m long, so the size tells the template's unit.
    if np.ptp(verts, axis=0).max() > LONGEST_M:
        verts = verts / MM_PER_M
    check_solid(str(folder / "mesh.obj"), verts, faces)
    check_product(str(folder / "mesh.obj"), len(rows), len(verts))
    file = view.raw("object")
    poses = array_entry(str(file), load_npy(file), (n_rows, 7))[rows]
    check_turns(str(file), poses[:, 1:4], valid)
    angles = poses[:, 0]
    if angles.any():
        is_top = _top_vertices(folder, len(verts))
        # The lid turns about the template's -z, before the whole object moves.
        turns = Rotation.from_rotvec(angles[:, None] * np.array([0.0, 0.0, -1.0])).as_matrix()
        bent = np.repeat(verts[None], len(rows), axis=0)
        bent[:, is_top] = np.einsum("tij,nj->tni", turns, verts[is_top])
        verts = bent
    return ObjectTruth(
        verts=verts,
        faces=faces,
        rotations=Rotation.from_rotvec(poses[:, 1:4]).as_matrix(),
        transl=poses[:, 4:] / MM_PER_M,
        valid=valid,
    )


def _top_vertices(folder: Path, n_verts: int) -> np.ndarray:
    """Which vertices [V] turn with the articulation, bool.

    The documentation calls part 1 the top, the code that scores calls part 0 so. The boxes of both parts
    decide where they are given, else the code.
    """
    parts_file, boxes_file = folder / "parts.json", folder / "object_params.json"
    parts = array_entry(str(parts_file), read_json(parts_file), (n_verts,))
    top = 0
    if boxes_file.is_file() and len(np.unique(parts)) == 2:
        boxes = mapping_entry(str(boxes_file), read_json(boxes_file))
        corners = {
            part: array_entry(f"{boxes_file}: bbox_{part}", boxes.get(f"bbox_{part}", []), (8, 3))
            for part in ("top", "bottom")
        }
        verts, _ = read_mesh(folder / "mesh.obj")
        middle = verts[parts == 0].mean(axis=0)
        distance = {part: np.linalg.norm(middle - box.mean(axis=0)) for part, box in corners.items()}
        top = 0 if distance["top"] < distance["bottom"] else 1
    return parts == top
