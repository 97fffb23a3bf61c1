"""Preview pictures and videos from plain image arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_shape

_GAP = 4
# A cell is at most this many times as high as wide.
_HIGHEST_CELL = 3
# The encoder's limit for a side is 16384; larger frames are shrunk.
_VIDEO_SIDE = 8192
_FONT_SIZE = 14
_CAPTION_HEIGHT = 22
_PAPER, _INK, _EMPTY = (255, 255, 255), (20, 20, 20), (236, 236, 236)
# Every player decodes 4:2:0; quality 20 leaves no visible blocks at these sizes.
_PIXEL_FORMAT = "yuv420p"
# The encoder's usual preset takes twice as long for files of the same size.
_ENCODING: dict[str, object] = {"crf": "20", "preset": "veryfast"}


def to_bytes(image: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] as uint8: floats are meant to be in [0, 1] and clipped; not-a-number is black."""
    if image.dtype == np.uint8:
        return image
    return np.round(255.0 * np.clip(np.nan_to_num(image, nan=0.0), 0.0, 1.0)).astype(np.uint8)


def difference(render: np.ndarray, image: np.ndarray, gain: float = 3.0) -> np.ndarray:
    """Where a render is wrong: grey where it agrees with the image, brighter or darker where it does not.

    Args:
        render: [H, W, 3] uint8, or float in [0, 1].
        image: [H, W, 3] likewise.
        gain: how much differences are magnified.

    Returns:
        [H, W, 3] uint8.
    """
    error = to_bytes(render).astype(np.float64) - to_bytes(image)
    return np.clip(128.0 + gain * error, 0.0, 255.0).astype(np.uint8)


def overlay(render: np.ndarray, alpha: np.ndarray, image: np.ndarray, strength: float = 0.7) -> np.ndarray:
    """The render laid over the dimmed image, so that misplaced outlines show.

    Args:
        render: [H, W, 3] uint8, or float in [0, 1], over black (premultiplied).
        alpha: coverage [H, W] in [0, 1].
        image: [H, W, 3] uint8, or float in [0, 1].
        strength: weight of the render where it covers.

    Returns:
        [H, W, 3] uint8.
    """
    kept = 1.0 - strength * np.clip(alpha, 0.0, 1.0)[..., None]
    mixed = strength * to_bytes(render).astype(np.float64) + kept * to_bytes(image)
    return np.clip(np.round(mixed), 0.0, 255.0).astype(np.uint8)


def contact_sheet(
    rows: Mapping[str, Sequence[np.ndarray | None]], captions: Sequence[str], cell_width: int = 240
) -> Image.Image:
    """Images as a captioned table: a row for each kind of picture, a column for each frame.

    Args:
        rows: name of the row -> one image per column, [H, W, 3] uint8 or float in [0, 1]; None leaves the
            cell empty.
        captions: name of each column.
        cell_width: width in pixels to which every image is scaled, keeping its proportions; one that is very
            high is narrower.

    Raises:
        InputError: a row has another number of images than there are captions, or an image another shape.
    """
    if not rows or not captions:
        raise InputError(f"contact sheet: expected pictures, found {len(rows)} rows, {len(captions)} columns")
    cells: dict[str, list[Image.Image | None]] = {}
    for name, images in rows.items():
        if len(images) != len(captions):
            raise InputError(f"contact sheet {name!r}: expected {len(captions)} images, found {len(images)}")
        cells[name] = [None if image is None else _cell(name, image, cell_width) for image in images]
    heights = {
        name: max((cell.height for cell in row if cell is not None), default=_CAPTION_HEIGHT)
        for name, row in cells.items()
    }
    font = ImageFont.load_default(_FONT_SIZE)
    label_width = _GAP * 4 + max(round(font.getlength(name)) for name in rows)
    width = label_width + len(captions) * (cell_width + _GAP)
    height = _CAPTION_HEIGHT + sum(height + _GAP for height in heights.values())
    sheet = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    lefts = [label_width + column * (cell_width + _GAP) for column in range(len(captions))]
    for left, caption in zip(lefts, captions, strict=True):
        centre = (left + cell_width / 2, _CAPTION_HEIGHT / 2)
        draw.text(centre, _fitting(caption, font, cell_width), _INK, font, anchor="mm")
    top = _CAPTION_HEIGHT
    for name, row in cells.items():
        draw.text((2 * _GAP, top + heights[name] / 2), name, _INK, font, anchor="lm")
        for left, cell in zip(lefts, row, strict=True):
            if cell is None:
                draw.rectangle((left, top, left + cell_width - 1, top + heights[name] - 1), _EMPTY)
            else:
                sheet.paste(cell, (left, top))
        top += heights[name] + _GAP
    return sheet


def save_picture(path: str | Path, picture: Image.Image) -> None:
    """Write a PNG or JPEG, by suffix; `path` is whole or absent.

    Raises:
        InputError: another suffix.
    """
    kind = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}.get(Path(path).suffix.lower())
    if kind is None:
        raise InputError(f"{path}: suffix: expected .png or .jpg, found {Path(path).suffix or 'none'}")
    with atomic_write(path) as file:
        # Harder compression takes five times as long, to make pictures smaller by an eighth.
        picture.save(file, kind, compress_level=1)


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write an H.264 video; `path` is whole or absent.

    Args:
        path: an .mp4 file.
        frames: [H, W, 3] uint8 or float in [0, 1], all of one size; read one at a time. An odd width or
            height is continued by a pixel, because the format needs even ones; a side beyond 8192 pixels is
            shrunk to that.
        fps: frames a second.

    Raises:
        InputError: PyAV is not installed, there is no frame, or the frames differ in size.
    """
    try:
        import av
    except ImportError as error:
        raise InputError(
            f"{path}: expected the extra 'video' (pip install 'bigs[video]'), found no PyAV"
        ) from error
    with atomic_write(path) as file, av.open(file, "w", format="mp4") as container:
        stream = None
        size: tuple[int, ...] = ()
        for index, frame in enumerate(frames):
            pixels = to_bytes(frame)
            if stream is None:
                check_shape(f"{path}: frame 0", pixels, ("H", "W", 3))
                size = pixels.shape
                shrink = min(1.0, _VIDEO_SIDE / max(size))
                shown = [max(1, round(shrink * side)) for side in size[:2]]
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = (side + side % 2 for side in shown)
                stream.pix_fmt, stream.options = _PIXEL_FORMAT, _ENCODING
            check_shape(f"{path}: frame {index}", pixels, size)
            if shrink < 1.0:
                small = Image.fromarray(pixels).resize((shown[1], shown[0]), Image.Resampling.LANCZOS)
                pixels = np.asarray(small)
            even = np.pad(pixels, ((0, shown[0] % 2), (0, shown[1] % 2), (0, 0)), mode="edge")
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        if stream is None:
            raise InputError(f"{path}: expected at least one frame, found none")
        container.mux(stream.encode())


def _cell(name: str, image: np.ndarray, width: int) -> Image.Image:
    check_shape(f"contact sheet {name!r}", image, ("H", "W", 3))
    picture = Image.fromarray(to_bytes(image))
    scale = min(width / picture.width, _HIGHEST_CELL * width / picture.height)
    size = (max(1, round(scale * picture.width)), max(1, round(scale * picture.height)))
    return picture.resize(size, Image.Resampling.LANCZOS)


def _fitting(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int) -> str:
    """The text, cut at its end until it fits."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(f"{text}…") > width:
        text = text[:-1]
    return f"{text}…"
