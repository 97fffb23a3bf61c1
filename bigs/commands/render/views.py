"""`bigs render`: the cameras and frames of a run, and the pictures, depths and video."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_pixels
from bigs.commands.folder.contents import load_run
from bigs.commands.render.frame import render_depth, render_frame, straight_rgba, turned_camera
from bigs.data.formats.transforms import MOST_CAMERAS, MOST_PIXELS, RenderCamera
from bigs.data.render_cameras import CameraPath, load_cameras
from bigs.models.playback import Playback
from bigs.types import USUAL_FPS, Entity
from bigs.viewer.preview import save_picture, to_bytes, write_video

# Pictures of an orbit of one frame: four seconds.
TURN = 120
# Largest 16-bit depth in millimetres.
_FARTHEST_MM = 65535

World = Literal["camera", "object"]
About = Literal["object", "scene"]
DepthFormat = Literal["png", "npy"]


@dataclass(frozen=True)
class Shot:
    """What `bigs render` shows: one of `cameras`, `orbit` and `from_input`."""

    cameras: Path | None = None
    orbit: bool = False
    from_input: bool = False
    frame: int | None = None  # the frame to show
    play: bool = False  # show the next frame of the clip in each picture, in a loop
    about: About | None = None  # centre of the orbit; the object if there is one
    pictures: int | None = None  # number of pictures of the orbit
    size: tuple[int, int] | None = None  # width and height for cameras without a size
    world: World | None = None  # frame of a file's cameras; the clip's camera frame if None


@dataclass(frozen=True)
class Wanted:
    """What is to be written."""

    pictures: Path | None = None  # folder
    video: Path | None = None
    depth: DepthFormat | None = None
    background: tuple[int, int, int] | None = None  # None: transparent pictures, black in a video


def render_run(
    run: Path, shot: Shot, wanted: Wanted, listen: Callable[[str], None] = lambda _: None
) -> list[Path]:
    """Render a finished run; returns the files, pictures first.

    Args:
        run: the run folder.
        shot: from where, and when.
        wanted: `pictures/%04d.png` are RGBA with straight colour, or RGB where there is a background;
            `pictures/depth/%04d.png` are 16-bit millimetres and `.npy` float32 metres of camera z, both 0
            where half of the light or more passes.
        listen: receives the progress.

    Raises:
        InputError: the run or the cameras are not as they should be, options that do not go together, or no
            PyAV for a video.
    """
    _check(shot, wanted)
    playback = load_run(run)
    cameras, fps = views_of(playback, shot)
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if wanted.video is not None and len(sizes) > 1:
        (w, h), (v, g) = sizes[0], sizes[-1]
        raise InputError(f"--video: expected cameras of one size, found {w} x {h} and {v} x {g}")
    files: list[Path] = []
    frames = _rendered(playback, cameras, wanted, files, listen)
    if wanted.video is None:
        for _ in frames:
            pass
    else:
        wanted.video.parent.mkdir(parents=True, exist_ok=True)
        if fps is None:
            plays = len({camera.frame_index for camera in cameras}) > 1
            fps = playback.fps if plays else USUAL_FPS
        write_video(wanted.video, frames, fps)
        files.append(wanted.video)
    return files


def views_of(playback: Playback, shot: Shot) -> CameraPath:
    """The cameras of a shot, in the order of their pictures; each one's world is the clip's camera frame of
    its time.

    Raises:
        InputError: as `render_run`.
    """
    if shot.frame is not None and not 0 <= shot.frame < len(playback):
        raise InputError(f"--frame: expected a number from 0 to {len(playback) - 1}, found {shot.frame}")
    if shot.cameras is not None:
        return _from_file(playback, shot.cameras, shot)
    K, width, height = _lens(playback, shot.size)
    if shot.from_input:
        times = range(len(playback)) if shot.frame is None else [shot.frame]
        return CameraPath([RenderCamera(t, np.eye(4), K, width, height) for t in times], None)
    return CameraPath(_turn(playback, shot, K, width, height), None)


def background_of(text: str) -> tuple[int, int, int] | None:
    """The colour that "white", "black" or "R,G,B" names, 8 bits each; None for "transparent".

    Raises:
        InputError: the text is none of these.
    """
    named = {"white": (255, 255, 255), "black": (0, 0, 0), "transparent": None}
    if text in named:
        return named[text]
    parts = text.split(",")
    if len(parts) != 3 or not all(re.fullmatch("[0-9]{1,3}", part) and int(part) <= 255 for part in parts):
        raise InputError(
            f"--background: expected white, black, transparent or R,G,B (each from 0 to 255), found {text!r}"
        )
    red, green, blue = map(int, parts)
    return red, green, blue


def _check(shot: Shot, wanted: Wanted) -> None:
    ways = {"--cameras": shot.cameras is not None, "--orbit": shot.orbit, "--from-input": shot.from_input}
    chosen = [name for name, given in ways.items() if given]
    if len(chosen) != 1:
        raise InputError(
            f"cameras: expected one of --cameras FILE, --orbit and --from-input, "
            f"found {' and '.join(chosen) or 'none'}"
        )
    if wanted.pictures is None and wanted.video is None:
        raise InputError("output: expected --out DIR for pictures, --video FILE.mp4 or both, found neither")
    if wanted.depth is not None and wanted.pictures is None:
        raise InputError("--depth: expected --out DIR with it, found none")
    if wanted.video is not None and wanted.video.suffix.lower() != ".mp4":
        raise InputError(f"--video: expected a name that ends with .mp4, found {wanted.video.name}")
    if shot.frame is not None and shot.play:
        raise InputError(f"--play: expected this or --frame, found both (--frame {shot.frame})")
    alone = (
        ("--about", shot.about, "--orbit", shot.orbit),
        ("--pictures", shot.pictures, "--orbit", shot.orbit),
        ("--world", shot.world, "--cameras", shot.cameras is not None),
    )
    for name, value, needs, given in alone:
        if value is not None and not given:
            raise InputError(f"{name} {value}: expected {needs} with it, found {chosen[0]}")
    if shot.pictures is not None and not 1 <= shot.pictures <= MOST_CAMERAS:
        raise InputError(f"--pictures: expected a number from 1 to {MOST_CAMERAS}, found {shot.pictures}")
    if shot.size is not None:
        if min(shot.size) < 1:
            raise InputError(f"--size: expected two positive numbers, found {shot.size[0]} {shot.size[1]}")
        check_pixels("--size", *shot.size, MOST_PIXELS)


def _from_file(playback: Playback, path: Path, shot: Shot) -> CameraPath:
    size = shot.size or (playback.width, playback.height)
    chosen = shot.play or shot.frame is not None
    found = load_cameras(
        path,
        frame_count=len(playback),
        time_of=(lambda index: _time(playback, shot, index)) if chosen else None,
        size=size,
    )
    for camera in found.cameras:
        if shot.size is not None and (camera.width, camera.height) != shot.size:
            raise InputError(
                f"--size {size[0]} {size[1]}: expected none beside cameras that have their size, "
                f"found {camera.width} x {camera.height} in {path}"
            )
    if shot.world != "object":
        return found
    if playback.object is None:
        raise InputError("--world object: expected a run with an object, found none in it")
    cameras = [
        camera._replace(viewmat=camera.viewmat @ _object_from_cam(playback, camera.frame_index))
        for camera in found.cameras
    ]
    return found._replace(cameras=cameras)


def _time(playback: Playback, shot: Shot, index: int) -> int:
    """The frame that a picture shows: the clip plays, or rests at the one chosen or at its middle."""
    if shot.play:
        return index % len(playback)
    return len(playback) // 2 if shot.frame is None else shot.frame


def _object_from_cam(playback: Playback, frame: int) -> np.ndarray:
    """From the clip's camera frame to the object's axes and place at that time, metres in both: [4, 4]."""
    assert playback.object is not None
    rotation = playback.object.rotations[frame].double().numpy()
    motion = np.eye(4)
    motion[:3, :3] = rotation.T
    motion[:3, 3] = -rotation.T @ playback.object.centers[frame].double().numpy()
    return motion


def _lens(playback: Playback, size: tuple[int, int] | None) -> tuple[np.ndarray, int, int]:
    """The clip's own camera, or one of another size with the same vertical angle about the same axis."""
    K = playback.K.double().numpy().copy()
    if size is None:
        return K, playback.width, playback.height
    width, height = size
    zoom = height / playback.height
    K[:2, :2] *= zoom
    K[0, 2] = width / 2 + zoom * (K[0, 2] - playback.width / 2)
    K[1, 2] *= zoom
    return K, width, height


def _turn(playback: Playback, shot: Shot, K: np.ndarray, width: int, height: int) -> list[RenderCamera]:
    """A whole turn about a point that stays, the middle of where its subject is in the times shown."""
    count = shot.pictures or (len(playback) if shot.play else TURN)
    times = [_time(playback, shot, index) for index in range(count)]
    about = shot.about or ("scene" if playback.object is None else "object")
    if about == "object" and playback.object is None:
        raise InputError("--about object: expected a run with an object, found none in it")
    entities: tuple[Entity, ...] = ("object",) if about == "object" else playback.entities
    places = [playback.gaussians([t], entities).means[0].median(0).values for t in sorted(set(times))]
    middle = torch.stack(places).mean(0)
    return [
        RenderCamera(t, turned_camera(middle, 360.0 * i / count).double().numpy(), K, width, height)
        for i, t in enumerate(times)
    ]


def _rendered(
    playback: Playback,
    cameras: list[RenderCamera],
    wanted: Wanted,
    files: list[Path],
    listen: Callable[[str], None],
) -> Iterator[np.ndarray]:
    """Renders and writes picture after picture, adds the files, and gives the video's frames [H, W, 3]."""
    for index, camera in enumerate(cameras):
        listen(f"picture {index + 1} of {len(cameras)}")
        viewmat, K = (torch.as_tensor(x, dtype=torch.float32) for x in (camera.viewmat, camera.K))
        view = (playback, camera.frame_index, viewmat, K, camera.width, camera.height)
        color, alpha = render_frame(*view)
        backed = to_bytes(over(color, alpha, wanted.background or (0, 0, 0)))
        if wanted.pictures is not None:
            if wanted.background is None:
                picture = Image.fromarray(straight_rgba(color, alpha), "RGBA")
            else:
                picture = Image.fromarray(backed)
            wanted.pictures.mkdir(parents=True, exist_ok=True)
            path = wanted.pictures / f"{index:04d}.png"
            save_picture(path, picture)
            files.append(path)
        if wanted.pictures is not None and wanted.depth is not None:
            path = wanted.pictures / "depth" / f"{index:04d}.{wanted.depth}"
            path.parent.mkdir(exist_ok=True)
            write_depth(path, render_depth(*view))
            files.append(path)
        yield backed


def over(color: np.ndarray, alpha: np.ndarray, background: tuple[int, int, int]) -> np.ndarray:
    """Colour over black [H, W, 3] and alpha [H, W], laid over a background of 8-bit red, green and blue."""
    return color + (1.0 - alpha[..., None]) * np.array(background, color.dtype) / 255.0


def write_depth(path: Path, depth: np.ndarray) -> None:
    """Depth [H, W] in metres as 16-bit millimetres (.png; what is further than 65.535 m is there) or as it is
    (.npy)."""
    with atomic_write(path) as file:
        if path.suffix == ".npy":
            np.save(file, depth.astype(np.float32))
        else:
            millimetres = np.round(1000.0 * depth.astype(np.float64)).clip(0, _FARTHEST_MM)
            Image.fromarray(millimetres.astype(np.uint16)).save(file, "PNG")
