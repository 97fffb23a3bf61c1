"""Intrinsics from the user, a COLMAP model, a data set, the file's metadata, or an assumption."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bigs.checks import InputError, found_at
from bigs.colmap import pycolmap
from bigs.data.entries import LARGEST, array_entry
from bigs.data.formats.arctic import camera_of_images
from bigs.data.formats.colmap_files import check_model_files
from bigs.preprocess.frames.source import Source

# Without any information the focal length is assumed to be this many times the longer side (46 degrees
# across).
ASSUMED_FOCAL = 1.2
# Diagonal of a 35 mm picture, to which "35 mm equivalent" focal lengths refer, millimetres.
_FULL_FRAME_DIAGONAL = 43.27
# Names of the entries in EXIF and QuickTime.
_EXIF_FOCAL_35MM = 0xA405
_QUICKTIME_FOCAL_35MM = "focal_length.35mm_equivalent"


@dataclass(frozen=True)
class Camera:
    """Intrinsics at the source's own size."""

    K: np.ndarray  # [3, 3]; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5)
    found: str  # how it was found, in words
    known: bool  # whether it is more than an assumption


@dataclass(frozen=True)
class CameraRequest:
    """The user's camera options at the source's own size; at most one of the three."""

    K: tuple[float, float, float, float] | None = None  # fx, fy, cx, cy pixels
    focal: float | None = None  # pixels
    colmap: Path | None = None  # folder of a COLMAP model


def find_camera(request: CameraRequest, source: Source, width: int, height: int) -> Camera:
    """The camera of a source.

    Args:
        request: what the user gave.
        source: of the pictures, which may say something of their camera.
        width, height: of its pictures, pixels.

    Raises:
        InputError: more than one source is given, or what is given makes no camera.
    """
    given = [name for name, value in vars(request).items() if value is not None]
    if len(given) > 1:
        raise InputError(f"camera: expected one of K, focal and colmap, found {' and '.join(given)}")
    if request.K is not None:
        fx, fy, cx, cy = request.K
        if not (min(fx, fy) > 0 and max(fx, fy) < LARGEST and 0 <= cx <= width and 0 <= cy <= height):
            raise InputError(
                "K: expected fx fy cx cy with positive focal lengths and the centre within "
                f"{width} x {height}, found {fx:g} {fy:g} {cx:g} {cy:g}"
            )
        return Camera(_matrix(fx, fy, cx, cy), "given as K", True)
    if request.focal is not None:
        if not 0 < request.focal < LARGEST:
            raise InputError(f"focal: expected a positive number of pixels, found {request.focal:g}")
        return Camera(_centred(request.focal, width, height), "given as focal length", True)
    if request.colmap is not None:
        return _from_colmap(request.colmap, width, height)
    annotated = camera_of_images(source.path)
    if annotated is not None:
        K, (own_width, own_height) = annotated
        factors = _factors(str(source.path), (own_width, own_height), width, height)
        return Camera(scale_camera(K, *factors), "from ARCTIC's misc.json", True)
    equivalent = _equivalent_focal(source.exif, source.tags)
    if equivalent is not None:
        focal = equivalent / _FULL_FRAME_DIAGONAL * float(np.hypot(width, height))
        return Camera(
            _centred(focal, width, height), f"from the file: {equivalent:g} mm, 35 mm equivalent", True
        )
    focal = ASSUMED_FOCAL * max(width, height)
    found = f"assumed: {focal:.0f} pixels, {ASSUMED_FOCAL:g} times the longer side"
    return Camera(_centred(focal, width, height), found, False)


def scale_camera(K: np.ndarray, factor_x: float, factor_y: float) -> np.ndarray:
    """K [3, 3] of the same picture at another size."""
    return np.diag([factor_x, factor_y, 1.0]) @ K


def _matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _centred(focal: float, width: int, height: int) -> np.ndarray:
    return _matrix(focal, focal, width / 2, height / 2)


def _from_colmap(folder: Path, width: int, height: int) -> Camera:
    """The first camera of a COLMAP model; another image size of the same proportions is scaled."""
    if not folder.is_dir():
        raise InputError(f"{folder}: expected the folder of a COLMAP model, found {found_at(folder)}")
    check_model_files(folder)
    try:
        cameras = pycolmap.Reconstruction(str(folder)).cameras
    except Exception as error:  # pycolmap raises its C++ exceptions
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{folder}: expected a COLMAP model (cameras, images, points3D), found {reason}"
        ) from None
    if not cameras:
        raise InputError(f"{folder}: expected a COLMAP model with a camera, found none in it")
    camera = cameras[min(cameras)]
    K = array_entry(f"{folder}: camera", camera.calibration_matrix(), (3, 3))
    if min(camera.width, camera.height) < 1 or min(K[0, 0], K[1, 1]) <= 0:
        raise InputError(
            f"{folder}: camera: expected a size and positive focal lengths, found {camera.width} x "
            f"{camera.height} and {K[0, 0]:g}, {K[1, 1]:g}"
        )
    factors = _factors(str(folder), (camera.width, camera.height), width, height)
    bent = "" if len(camera.params) <= 4 and "RADIAL" not in camera.model.name else ", distortion left out"
    return Camera(scale_camera(K, *factors), f"from COLMAP ({camera.model.name}{bent})", True)


def _factors(where: str, own: tuple[int, int], width: int, height: int) -> tuple[float, float]:
    """From a camera of size `own` to pictures of `width` x `height`, across and down."""
    factors = width / own[0], height / own[1]
    if abs(factors[0] / factors[1] - 1) > 0.02:
        raise InputError(
            f"{where}: expected a camera with the proportions of {width} x {height}, "
            f"found {own[0]} x {own[1]}"
        )
    return factors


def _equivalent_focal(exif: Mapping[int, object], tags: Mapping[str, str]) -> float | None:
    """The 35 mm equivalent focal length in millimetres, where the camera wrote one."""
    found = [exif.get(_EXIF_FOCAL_35MM)]
    found += [value for name, value in tags.items() if name.lower().endswith(_QUICKTIME_FOCAL_35MM)]
    for value in found:
        try:
            focal = float(str(value))
        except ValueError:
            continue
        if focal > 0:
            return focal
    return None
