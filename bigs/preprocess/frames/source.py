"""Pictures one after the other, upright: from a video file or from a folder of images."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, ImageOps

from bigs.checks import InputError, check_pixels, found_at
from bigs.data.frame_rate import rate_by_names
from bigs.data.images import open_picture
from bigs.files import open_regular
from bigs.types import USUAL_FPS

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".gif")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
# FFmpeg's names of these containers, and their first bytes.
_CONTAINERS = {
    "mov": re.compile(rb".{4}(?:ftyp|moov|mdat|wide|free|skip|pnot)", re.DOTALL),
    "matroska": re.compile(rb"\x1a\x45\xdf\xa3"),
    "avi": re.compile(rb"RIFF.{4}AVI ", re.DOTALL),
    "gif": re.compile(rb"GIF8[79]a"),
    "mpeg": re.compile(rb"\x00\x00\x01\xba"),
    "mpegvideo": re.compile(rb"\x00\x00\x01\xb3"),
}
_HEAD_BYTES = 16
# A film that refers to other files would have them opened.
_OPTIONS = {"mov": {"enable_drefs": "0", "use_absolute_path": "0"}}
# An hour at 240 frames per second; a clip has hundreds of frames.
_MAX_FRAMES = 864_000


@dataclass(frozen=True)
class Source:
    """Where pictures come from, before any is decoded."""

    path: Path
    fps: float
    exif: Mapping[int, object] = field(default_factory=dict)  # of the first image
    tags: Mapping[str, str] = field(default_factory=dict)  # of the video
    images: tuple[Path, ...] = ()  # of a folder

    def pictures(self) -> Iterator[tuple[str, np.ndarray]]:
        """Name and pixels [H, W, 3] uint8 RGB of every picture, upright, in order.

        Raises:
            InputError: a picture cannot be decoded.
        """
        return self._folder_pictures() if self.images else self._video_pictures()

    def _folder_pictures(self) -> Iterator[tuple[str, np.ndarray]]:
        for path in self.images:
            with open_picture(path) as image:
                pixels = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
            yield path.name, pixels

    def _video_pictures(self) -> Iterator[tuple[str, np.ndarray]]:
        av = _import_av(self.path)
        index = 0
        try:
            with _open_video(av, self.path) as container:
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                for frame in container.decode(stream):
                    check_pixels(f"{self.path}: frame {index}", frame.width, frame.height)
                    if index >= _MAX_FRAMES:
                        raise InputError(f"{self.path}: expected at most {_MAX_FRAMES} frames, found more")
                    pixels = frame.to_ndarray(format="rgb24")
                    # The flag is the counter-clockwise rotation that sets the picture upright.
                    yield (
                        f"{index:06d}.png",
                        np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90))),
                    )
                    index += 1
        except av.FFmpegError as error:
            raise InputError(
                f"{self.path}: expected a readable video, found {error.strerror or error} after frame {index}"
            ) from None


def open_source(path: Path) -> Source:
    """Look at a video file or a folder of images.

    Raises:
        InputError: neither; or a video that cannot be opened, or the extra for videos is not installed.
    """
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES]
        if not files:
            raise InputError(
                f"{path}: expected images ({', '.join(PICTURE_SUFFIXES)}), found none in this folder"
            )
        images = tuple(sorted(files, key=natural_order))
        rate = rate_by_names([image.name for image in images])
        return Source(path, rate, exif=_exif(images[0]), images=images)
    if not path.exists():
        raise InputError(f"{path}: expected a video file or a folder of images, found {found_at(path)}")
    av = _import_av(path)
    try:
        with _open_video(av, path) as container:
            if not container.streams.video:
                raise InputError(f"{path}: expected a video, found a file without pictures")
            stream = container.streams.video[0]
            check_pixels(str(path), stream.width, stream.height)
            rate = stream.average_rate or stream.guessed_rate
            return Source(path, float(rate) if rate else USUAL_FPS, tags=dict(container.metadata))
    except av.FFmpegError as error:
        raise InputError(f"{path}: expected a readable video, found {error.strerror or error}") from None


@contextmanager
def _open_video(av: Any, path: Path) -> Iterator[Any]:
    """Open a video of one of the usual containers, since FFmpeg would follow a playlist anywhere.

    Raises:
        InputError: no regular file, or another kind; and what FFmpeg raises.
    """
    with open_regular(path, "a video") as file:
        head = file.read(_HEAD_BYTES)
        kind = next((kind for kind, begins in _CONTAINERS.items() if begins.match(head)), None)
        if kind is None:
            raise InputError(
                f"{path}: expected a readable video ({', '.join(VIDEO_SUFFIXES)}), found none by its content"
            )
        file.seek(0)
        with av.open(file, format=kind, options=_OPTIONS.get(kind, {})) as container:
            yield container


def is_source(path: Path) -> bool:
    """Whether a path looks like something to preprocess rather than like a finished clip."""
    if path.is_dir():
        finished = any((place / "data.npy").exists() for place in (path, path / "build"))
        return not finished and any(f.suffix.lower() in PICTURE_SUFFIXES for f in path.iterdir())
    return path.suffix.lower() in VIDEO_SUFFIXES


def _import_av(path: Path):  # type: ignore[no-untyped-def]  # PyAV's stubs are not asked for
    try:
        import av
    except ImportError:
        raise InputError(
            f"{path}: expected the extra 'video' (pip install 'bigs[video]') or a folder of images, "
            "found no PyAV"
        ) from None
    return av


def _exif(path: Path) -> dict[int, object]:
    """EXIF entries by number, those about the exposure among them."""
    with open_picture(path) as image:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """A key that sorts frame2 before frame10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]
