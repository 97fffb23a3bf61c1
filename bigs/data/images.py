"""Reading the frames of a clip: RGB images and label masks, each checked as it is read."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from bigs.checks import MAX_PIXELS, InputError, check_pixels, found_at
from bigs.files import open_regular
from bigs.names import check_name
from bigs.types import MASK_VALUES

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
MASK_SUFFIXES = (".png",)

# What Pillow raises for files that are no images, are truncated, or unpack to an absurd size.
UNREADABLE = (
    OSError,
    SyntaxError,
    ValueError,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)
# Pillow detects formats by content and delegates some to other programs; it decodes these itself.
PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
_FRAME_FORMATS = ("PNG", "JPEG")
_MASK_BYTES = bytes(sorted({0, *MASK_VALUES.values()}))
# Bytes of a picture of `MAX_PIXELS` with four 16-bit channels, uncompressed.
_MAX_PICTURE_BYTES = 1 << 29
# Pillow first warns and refuses at twice the size; a warning would be a second line beside the error.
warnings.filterwarnings("error", category=Image.DecompressionBombWarning)


@contextmanager
def open_picture(path: Path, formats: tuple[str, ...] = PICTURE_FORMATS) -> Iterator[Image.Image]:
    """A picture of one of some formats, not yet decoded, of a size that may be decoded.

    Raises:
        InputError: no such file, no regular file, another format, or too many pixels; and what Pillow raises
            while it is decoded inside the block.
    """
    with open_regular(path, "an image", _MAX_PICTURE_BYTES) as file:
        try:
            with Image.open(file, formats=formats) as image:
                check_pixels(str(path), image.width, image.height)
                yield image
        except InputError:
            raise
        except UNREADABLE as error:
            raise InputError(f"{path}: expected a readable image, found {_reason(error, formats)}") from None


def list_frames(folder: Path, suffixes: Sequence[str]) -> tuple[Path, ...]:
    """The image files of `folder` in name order, which is frame order.

    Raises:
        InputError: the folder is missing or holds no such file, or one whose name other systems refuse.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of frames, found {found_at(folder)}")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    if not paths:
        raise InputError(f"{folder}: expected frames ({', '.join(suffixes)}), found none")
    for path in paths:
        check_name(f"{folder}: frames", path.name)
    return tuple(paths)


def read_image(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """One frame, [H, W, 3] uint8 RGB.

    Args:
        path: image file, 8-bit RGB or grey.
        size: (width, height) it must have.

    Raises:
        InputError: unreadable, cut short, of another size, or neither RGB nor grey.
    """
    pixels, mode = _read(path, size)
    if mode == "L":
        return np.repeat(pixels[..., None], 3, axis=2)
    if mode != "RGB":
        raise InputError(f"{path}: expected an 8-bit RGB image, found mode {mode}")
    return pixels


def read_mask(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """The labels of one frame, [H, W] uint8: 0 or one of `bigs.types.MASK_VALUES`.

    Raises:
        InputError: unreadable, of another size, not one 8-bit channel, or holding any other value.
    """
    pixels, mode = _read(path, size)
    if mode != "L":
        raise InputError(f"{path}: expected a mask with one 8-bit channel (mode L), found mode {mode}")
    other = sorted(set(pixels.tobytes().translate(None, _MASK_BYTES)))
    if other:
        expected = ", ".join(map(str, _MASK_BYTES))
        raise InputError(
            f"{path}: expected the mask values {expected}, found {', '.join(map(str, other[:4]))}"
        )
    return pixels


def check_pairs(image_paths: Sequence[Path], mask_paths: Sequence[Path]) -> None:
    """Raise `InputError` unless there is a mask of the same name for each image."""
    mask_folder = mask_paths[0].parent
    if len(image_paths) != len(mask_paths):
        raise InputError(
            f"{mask_folder}: expected a mask for each of {len(image_paths)} images, found {len(mask_paths)}"
        )
    for image, mask in zip(image_paths, mask_paths, strict=True):
        if image.stem != mask.stem:
            raise InputError(f"{mask_folder}: expected a mask named {image.stem}, found {mask.name}")


def _read(path: Path, size: tuple[int, int] | None) -> tuple[np.ndarray, str]:
    with open_picture(path, _FRAME_FORMATS) as image:
        if size is not None and image.size != size:
            raise InputError(
                f"{path}: expected {size[0]} x {size[1]} pixels as in the first frame, "
                f"found {image.width} x {image.height}"
            )
        return np.array(image), image.mode


def _reason(error: BaseException, formats: Sequence[str]) -> str:
    if isinstance(error, Image.DecompressionBombError | Image.DecompressionBombWarning):
        return f"one that unpacks to more than {MAX_PIXELS} pixels ({error})"
    if isinstance(error, Image.UnidentifiedImageError):
        return f"a file that is not an image ({', '.join(formats)})"
    return f"a damaged or truncated one ({error})"
