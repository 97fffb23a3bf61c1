"""The first step: pictures of a source become numbered frames and `frames.json`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_positive
from bigs.data.formats.arctic import meta_of_images
from bigs.preprocess.artefacts import FRAMES, FRAMES_FILE, FrameSet, write_frame_set
from bigs.preprocess.frames.camera import CameraRequest, find_camera, scale_camera
from bigs.preprocess.frames.source import Source
from bigs.preprocess.stamps import content_digest

# Sharpness is compared on pictures of about this width, since finer grain is noise.
_COMPARED_WIDTH = 480
_FEWEST = 4


@dataclass(frozen=True)
class FrameConfig:
    """Which pictures become frames."""

    stride: int = 1  # keep every Nth picture
    sharpest: bool = False  # keep the sharpest picture of each stride, not the first
    start: int = 0  # number of the first picture to use
    count: int = 0  # most frames to keep; 0 keeps all
    fps: float | None = None  # of the source; None believes it
    max_size: int = 1280  # longer side in pixels to which larger frames are shrunk; 0 for none
    camera: CameraRequest = field(default_factory=CameraRequest)

    def check(self) -> None:
        """Raise `InputError` for values that mean nothing."""
        for name, least in (("stride", 1), ("start", 0), ("count", 0), ("max_size", 0)):
            if getattr(self, name) < least:
                raise InputError(
                    f"{name}: expected an integer of at least {least}, found {getattr(self, name)}"
                )
        if self.fps is not None:
            check_positive("fps", self.fps)


def frame_inputs(source: Source, config: FrameConfig) -> str:
    """The digest of `extract_frames`'s inputs."""
    parts = [source.path] if not source.images else list(source.images)
    cameras = [config.camera.colmap, meta_of_images(source.path)]
    return content_digest(*parts, asdict(config), *(path for path in cameras if path is not None))


def extract_frames(
    source: Source,
    processed: Path,
    config: FrameConfig,
    inputs: str,
    listen: Callable[[str], None] = lambda text: None,
) -> FrameSet:
    """Write `frames/%04d.png` and `frames.json`.

    Args:
        source: video or folder.
        processed: `CLIP/processed`; made if missing.
        config: which pictures, and the camera.
        inputs: what `frame_inputs` gave.
        listen: told how far it is.

    Raises:
        InputError: too few pictures, pictures of different sizes, or a source that cannot be decoded.
    """
    config.check()
    folder = processed / FRAMES
    folder.mkdir(parents=True, exist_ok=True)
    # There is no list until the new one is written, so images and list never disagree.
    (processed / FRAMES_FILE).unlink(missing_ok=True)
    size: tuple[int, int] | None = None
    names: list[str] = []
    indices: list[int] = []
    counter = _Counter()
    for index, name, pixels in _chosen(counter.count(source.pictures()), config):
        found = (pixels.shape[1], pixels.shape[0])
        size = size or found
        if found != size:
            raise InputError(
                f"{source.path}: {name}: expected {size[0]} x {size[1]} pixels as in the first frame, "
                f"found {found[0]} x {found[1]}"
            )
        with atomic_write(folder / f"{len(names):04d}.png") as file:
            # The fastest compression: these files are read a few times and never shipped.
            Image.fromarray(_shrunk(pixels, config.max_size)).save(file, "PNG", compress_level=1)
        names.append(name)
        indices.append(index)
        listen(f"{len(names)} frames")
    if len(names) < _FEWEST or size is None:
        raise InputError(
            f"{source.path}: expected at least {_FEWEST} frames, found {len(names)} of "
            f"{counter.seen} pictures (stride {config.stride}, start {config.start})"
        )
    for stale in folder.glob("*.png"):
        if stale.stem.isdigit() and int(stale.stem) >= len(names):
            stale.unlink()
    camera = find_camera(config.camera, source, *size)
    width, height = _shrunk_size(*size, config.max_size)
    frames = FrameSet(
        names=tuple(names),
        fps=(source.fps if config.fps is None else config.fps) / config.stride,
        width=width,
        height=height,
        K=scale_camera(camera.K, width / size[0], height / size[1]),
        camera=camera.found,
        focal_known=camera.known,
        source_frames=tuple(indices),
        source_length=counter.seen,
        source_size=size,
    )
    write_frame_set(processed, frames, inputs)
    return frames


def sharpness(pixels: np.ndarray) -> float:
    """Sharpness of a picture [H, W, 3] uint8: the variance of the Laplacian of its grey values."""
    step = max(1, pixels.shape[1] // _COMPARED_WIDTH)
    grey = pixels[::step, ::step].astype(np.float32).mean(axis=2)
    inner = grey[1:-1, 1:-1]
    around = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]
    return float((around - 4.0 * inner).var())


class _Counter:
    """Counts the items that pass."""

    def __init__(self) -> None:
        self.seen = 0

    def count(self, pictures: Iterator[tuple[str, np.ndarray]]) -> Iterator[tuple[str, np.ndarray]]:
        for picture in pictures:
            self.seen += 1
            yield picture


def _chosen(
    pictures: Iterator[tuple[str, np.ndarray]], config: FrameConfig
) -> Iterator[tuple[int, str, np.ndarray]]:
    """Place, name and pixels of the pictures that become frames; one stride is held in memory as one picture.

    The pictures after the last one wanted are still counted, because masks and keypoints may be numbered like
    the source.
    """
    best: tuple[int, str, np.ndarray] | None = None
    best_sharpness = -1.0
    given = 0
    for index, (name, pixels) in enumerate(pictures):
        if index < config.start or (config.count and given == config.count):
            continue
        place = (index - config.start) % config.stride
        if place == 0 and best is not None:
            yield best
            best, given = None, given + 1
            if config.count and given == config.count:
                continue
        found = sharpness(pixels) if config.sharpest and config.stride > 1 else float(place == 0)
        if best is None or found > best_sharpness:
            best, best_sharpness = (index, name, pixels), found
    if best is not None:
        yield best


def _shrunk_size(width: int, height: int, longest: int) -> tuple[int, int]:
    if not longest or max(width, height) <= longest:
        return width, height
    factor = longest / max(width, height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def _shrunk(pixels: np.ndarray, longest: int) -> np.ndarray:
    height, width = pixels.shape[:2]
    size = _shrunk_size(width, height, longest)
    if size == (width, height):
        return pixels
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX, reducing_gap=2.0))
