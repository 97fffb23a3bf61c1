"""Commands that make a clip from a video or from pictures: preprocess and its steps."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bigs.checks import InputError, found_at
from bigs.cli.terminal import say, telling, use_threads

if TYPE_CHECKING:
    from bigs.commands.preprocess.request import PreprocessRequest, StepName, StepOutcome
    from bigs.types import Entity


@dataclasses.dataclass(frozen=True)
class FrameOptions:
    """Which pictures become frames, and their camera."""

    K: tuple[float, float, float, float] | None = None
    """fx fy cx cy of the camera in pixels of the source; pixel centres at +0.5."""
    focal: float | None = None
    """Focal length in pixels of the source, with the centre of the picture as principal point."""
    colmap: Path | None = None
    """Folder of a COLMAP model whose first camera is the source's."""
    stride: int = 1
    """Keep every Nth frame."""
    sharpest: bool = False
    """Keep the sharpest picture of each stride, not the first."""
    start: int = 0
    """Number of the first picture to use."""
    count: int = 0
    """Stop after this many frames; 0 keeps all."""
    fps: float | None = None
    """Frames a second of the source; by default what a video, or the numbers of images, say."""
    max_size: int = 1280
    """Shrink larger pictures to this many pixels on the longer side; 0 keeps their size."""


@dataclasses.dataclass(frozen=True)
class MaskOptions:
    """Where the masks of the right hand, the left hand and the object come from."""

    masks: Path | None = None
    """Folder of masks: label images, or one folder each for right, left and object."""
    mask_labels: tuple[str, ...] = ()
    """Meaning of the mask values, such as right=1 left=2 object=3; by default 150, 250 and 50."""
    sam2: Path | None = None
    """Folder with the weights of a SAM 2 video model, which then makes the masks."""
    clicks: Path | None = None
    """JSON file of clicks or boxes for --sam2."""


@dataclasses.dataclass(frozen=True)
class HandOptions:
    """Where the hands come from."""

    keypoints: Path | None = None
    """JSON file with 21 keypoints of each hand in each frame; hands are fitted to them."""
    hands: Path | None = None
    """Output of a hand estimator (HaMeR, HOLD, WiLoR) instead of keypoints."""
    landmarker: Path | None = None
    """Model file of MediaPipe's HandLandmarker, which then finds the keypoints."""


@dataclasses.dataclass(frozen=True)
class ObjectOptions:
    """How the object's motion is found."""

    disk: Path | None = None
    """File with DISK's weights, to use its features instead of SIFT."""
    lightglue: Path | None = None
    """File with LightGlue's weights for DISK, to match its features."""
    exhaustive: bool = False
    """Match every pair of frames, not only the next ten: slower, and may confuse sides that look alike."""


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """Everything that preprocessing needs besides the pictures."""

    frames: Annotated[FrameOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=FrameOptions)
    masks: Annotated[MaskOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=MaskOptions)
    hands: Annotated[HandOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=HandOptions)
    object: Annotated[ObjectOptions, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=ObjectOptions
    )

    def given(self) -> list[str]:
        """The options that the user set, as written on the command line."""
        return [
            f"--{option.name.replace('_', '-')}"
            for group in (self.frames, self.masks, self.hands, self.object)
            for option in dataclasses.fields(group)
            if getattr(group, option.name) != option.default
        ]


NO_VIDEO = VideoOptions()
Flat = tyro.conf.arg(name="")
Clip = Annotated[Path, tyro.conf.Positional]


def preprocess(
    source: Clip,
    out: Path,
    options: Annotated[VideoOptions, Flat] = NO_VIDEO,
    hand_model: Path | None = None,
    redo: bool = False,
    threads: int = 0,
) -> None:
    """Make a clip from a video or a folder of images: frames, masks, hands, object, alignment, build folder.

    Args:
        source: a video file or a folder of images.
        out: the clip folder to make; steps whose artefacts below it are up to date are skipped.
        options: options of the steps.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        redo: make every artefact again, also those that another tool supplied.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    _run(_request(out, source, options, hand_model, redo), None)


def frames(
    source: Clip, out: Path, options: Annotated[FrameOptions, Flat] = FrameOptions(), redo: bool = False
) -> None:
    """Step 1: pictures as numbered frames, and the camera.

    Args:
        source: a video file or a folder of images.
        out: the clip folder.
        options: which pictures, and the camera.
        redo: make it again even if it is up to date.
    """
    _run(_request(out, source, VideoOptions(frames=options), None, redo), ("frames",))


def masks(
    clip: Clip,
    options: Annotated[MaskOptions, Flat] = MaskOptions(),
    keypoints: Path | None = None,
    redo: bool = False,
    threads: int = 0,
) -> None:
    """Step 2: label images of right hand, left hand and object.

    Args:
        clip: the clip folder.
        options: where the masks come from.
        keypoints: JSON file of the hands' keypoints, used instead of clicks on the hands with --sam2.
        redo: make it again even if it is up to date.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    if keypoints is not None and options.sam2 is None:
        raise InputError("--keypoints: expected --sam2 with it, found none")
    chosen = VideoOptions(masks=options, hands=HandOptions(keypoints=keypoints))
    _run(_request(clip, None, chosen, None, redo), ("masks",))


def object_motion(
    clip: Clip,
    options: Annotated[ObjectOptions, Flat] = ObjectOptions(),
    redo: bool = False,
    threads: int = 0,
) -> None:
    """Step 3: the object's motion and points, by structure from motion within its mask.

    Args:
        clip: the clip folder.
        options: features and pairs.
        redo: make it again even if it is up to date.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    _run(_request(clip, None, VideoOptions(object=options), None, redo), ("object",))


def hands(
    clip: Clip,
    options: Annotated[HandOptions, Flat] = HandOptions(),
    hand_model: Path | None = None,
    redo: bool = False,
    threads: int = 0,
) -> None:
    """Step 4: pose, shape and position of the hands.

    Args:
        clip: the clip folder.
        options: where the hands come from.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        redo: make it again even if it is up to date.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    _run(_request(clip, None, VideoOptions(hands=options), hand_model, redo), ("hands",))


def align(clip: Clip, hand_model: Path | None = None, redo: bool = False, threads: int = 0) -> None:
    """Step 5: hands and object in one metric space.

    Args:
        clip: the clip folder.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        redo: make it again even if it is up to date.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    _run(_request(clip, None, VideoOptions(), hand_model, redo), ("align",))


def build(clip: Clip, hand_model: Path | None = None, redo: bool = False) -> None:
    """Step 6: the build folder that HOLD and bigs reconstruct read.

    Args:
        clip: the clip folder.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        redo: make it again even if it is up to date.
    """
    _run(_request(clip, None, VideoOptions(), hand_model, redo), ("build",))


def clip_of(clip: Path, out: Path, options: VideoOptions, hand_model: Path | None) -> Path:
    """The clip given to `bigs reconstruct`, or the one made from a video in `out/clip`."""
    from bigs.preprocess.frames.source import is_source

    if not is_source(clip):
        if options.given():
            raise InputError(
                f"{clip}: expected a video or a folder of images for {', '.join(options.given())}, "
                f"found {'a clip or another folder' if clip.is_dir() else found_at(clip)}"
            )
        return clip
    folder = out / "clip"
    _run(_request(folder, clip, options, hand_model, False), None)
    return folder


def _request(
    clip: Path, source: Path | None, options: VideoOptions, hand_model: Path | None, redo: bool
) -> PreprocessRequest:
    from bigs.commands.preprocess.request import PreprocessRequest
    from bigs.preprocess.frames.camera import CameraRequest
    from bigs.preprocess.frames.extract import FrameConfig

    chosen = dataclasses.asdict(options.frames)
    camera = CameraRequest(**{name: chosen.pop(name) for name in ("K", "focal", "colmap")})
    masks = dataclasses.asdict(options.masks)
    labels = masks.pop("mask_labels")
    return PreprocessRequest(
        clip=clip,
        source=source,
        frames=FrameConfig(**chosen, camera=camera),
        **masks,
        mask_labels=_labels(labels) if labels else None,
        **dataclasses.asdict(options.hands),
        **dataclasses.asdict(options.object),
        hand_model=hand_model,
        redo=redo,
    )


def _labels(words: tuple[str, ...]) -> dict[Entity, int]:
    """Parse right=1 left=2 object=3 into a dictionary."""
    from bigs.types import ENTITIES

    found: dict[Entity, int] = {}
    for word in words:
        name, _, value = word.partition("=")
        entity = next((entity for entity in ENTITIES if entity == name), None)
        if entity is None or not value.isdigit():
            raise InputError(
                f"--mask-labels: expected right=1, left=2 or object=3 and the like, found {word!r}"
            )
        found[entity] = int(value)
    if len(set(found.values())) != len(found):
        raise InputError(f"--mask-labels: expected a value for each entity, found {' '.join(words)}")
    return found


def _run(request: PreprocessRequest, steps: tuple[StepName, ...] | None) -> None:
    from bigs.commands.preprocess.all_steps import preprocess as run
    from bigs.commands.preprocess.request import STEPS

    with telling() as tell:
        run(request, STEPS if steps is None else steps, tell, _tell)


def _tell(outcome: StepOutcome) -> None:
    say(f"{outcome.name:7s} {outcome.state}, {outcome.seconds:.1f} s: {outcome.summary}")
    for note in outcome.notes:
        say(f"        {note}")
    if outcome.picture is not None:
        say(f"        see {outcome.picture}")
