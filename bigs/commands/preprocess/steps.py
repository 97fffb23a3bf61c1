"""The steps of preprocessing that make frames, masks, hands and the build folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from bigs.checks import InputError, found_at
from bigs.commands.preprocess.pictures import draw_clip, tinted, with_skeletons, write_sheet
from bigs.commands.preprocess.request import PreprocessRequest, StepOutcome, kept
from bigs.data.base import HandTrack
from bigs.data.formats.hold import load_hold
from bigs.data.images import read_image, read_mask
from bigs.data.oddities.repeats import every_new
from bigs.hand import HandModel, load_hand_models
from bigs.preprocess.artefacts import (
    ALIGNED_FILE,
    FRAMES,
    FRAMES_FILE,
    HANDS_FILE,
    MASKS,
    MASKS_FILE,
    SFM_FILE,
    USUAL_DEPTH_SIGMA,
    FrameSet,
    frame_paths,
    mask_paths,
    read_alignment,
    read_frame_set,
    read_hands,
    read_notes,
    read_object_sfm,
    write_hands,
)
from bigs.preprocess.build import write_build
from bigs.preprocess.frames.extract import extract_frames, frame_inputs
from bigs.preprocess.frames.frame_ranges import frame_ranges
from bigs.preprocess.frames.source import open_source
from bigs.preprocess.hands.dumps import read_hand_dump
from bigs.preprocess.hands.fit import HandFitConfig
from bigs.preprocess.hands.imported import import_hands
from bigs.preprocess.hands.keypoints import read_keypoints, write_keypoints
from bigs.preprocess.hands.landmarker import find_keypoints
from bigs.preprocess.hands.tracks import HandEstimates, fit_hands, joints_of_track
from bigs.preprocess.masks.checks import check_masks
from bigs.preprocess.masks.clicks import add_hand_clicks, read_clicks
from bigs.preprocess.masks.masks import MaskSource, open_masks, write_masks
from bigs.preprocess.masks.sam2 import load_sam2, no_weights, segment_clip
from bigs.preprocess.object.surface_points import SurfacePointsConfig, complete_points
from bigs.preprocess.stamps import content_digest, write_json
from bigs.types import Side

BUILD_FILE = "build.json"
Listen = Callable[[str], None]


def frames_step(request: PreprocessRequest, listen: Listen) -> StepOutcome:
    """Pictures of the source as `frames/` and `frames.json`."""
    processed = request.processed
    file = processed / FRAMES_FILE
    picture = processed / "frames.png"
    if request.source is None:
        frames = read_frame_set(processed)
        return StepOutcome("frames", "supplied", _frames_summary(frames), (), None)
    source = open_source(request.source)
    request.frames.check()
    inputs = frame_inputs(source, request.frames)
    state = request.state(file, inputs)
    if state in ("current", "supplied"):
        frames = read_frame_set(processed)
        frame_paths(processed, frames)
        return kept("frames", state, _frames_summary(frames), picture)
    frames = extract_frames(source, processed, request.frames, inputs, listen)
    paths = frame_paths(processed, frames)
    write_sheet(picture, paths, frames.names, lambda t, image: image)
    notes = []
    if not frames.focal_known:
        notes.append(f"camera {frames.camera}: give --K, --focal or --colmap if you can")
    every = every_new(lambda t: read_image(paths[t]), len(paths))
    if every > 1:
        stride = every * request.frames.stride
        notes.append(
            f"of {every} pictures in a row one is new, the rest repeat it: --stride {stride} skips those"
        )
    return StepOutcome("frames", "made", _frames_summary(frames), tuple(notes), picture)


def masks_step(request: PreprocessRequest, listen: Listen) -> StepOutcome:
    """Label images as `masks/` and what looks wrong in them as `masks.json`."""
    processed = request.processed
    frames = read_frame_set(processed)
    file, picture = processed / MASKS_FILE, processed / "masks.png"
    if request.masks is None and request.sam2 is None:
        if request.mask_labels or request.clicks is not None:
            raise InputError("--mask-labels, --clicks: expected --masks or --sam2 with them, found neither")
        return _supplied_masks(request, frames, picture)
    if request.masks is not None:
        inputs, label_source = _given_masks(request, frames)
    else:
        inputs, label_source = _sam2_masks(request, frames, listen)
    state = request.state(file, inputs)
    if state in ("current", "supplied"):
        mask_paths(processed, frames)
        return kept("masks", state, "as they are", picture, read_notes(file))
    source = label_source()
    found: list[str] = []

    def check(masks: list[np.ndarray], twice: list[int]) -> list[str]:
        found.extend(check_masks(masks, twice, frames.names))
        return found

    masks = write_masks(processed, frames, source.label, inputs, check)
    _draw_masks(picture, processed, frames, masks)
    return StepOutcome("masks", "made", f"from {source.layout}", tuple(found), picture)


def hands_step(request: PreprocessRequest, listen: Listen) -> StepOutcome:
    """`hands.npz` from keypoints, a detector, or another hand estimator."""
    processed = request.processed
    frames = read_frame_set(processed)
    file, picture = processed / HANDS_FILE, processed / "hands.png"
    chosen = hand_source(request)
    if chosen is None:
        hands = read_hands(file, len(frames.names))
        return StepOutcome("hands", "supplied", _hands_summary(hands), (), None)
    option, source = chosen
    config = HandFitConfig()
    inputs = content_digest(
        option,
        source,
        _frame_identity(frames),
        frames.K,
        processed / MASKS,
        _model_identity(request),
        asdict(config),
    )
    state = request.state(file, inputs)
    if state in ("current", "supplied"):
        return kept("hands", state, _hands_summary(read_hands(file, len(frames.names))), picture)
    models = load_hand_models(request.hand_model)
    labels = None
    if (processed / MASKS_FILE).exists():
        labels = [read_mask(path) for path in mask_paths(processed, frames)]
    if option == "--hands":
        means = {side: model.hands_mean.double().numpy() for side, model in models.items()}
        listen("reading")
        found = import_hands(read_hand_dump(source, frames, means), frames.K, models, labels)
    else:
        if option == "--landmarker":
            keypoints = find_keypoints(source, frame_paths(processed, frames), frames.fps, listen)
            write_keypoints(processed / "keypoints.json", keypoints, frames)
        else:
            keypoints = read_keypoints(source, frames)
        listen("fitting")
        found = fit_hands(keypoints, frames.K, models, fps=frames.fps, masks=labels, config=config)
    sigma = USUAL_DEPTH_SIGMA if option == "--hands" else config.depth_sigma
    write_hands(file, found.tracks, inputs, sigma)
    _draw_hands(picture, processed, frames, found, models)
    return StepOutcome("hands", "made", _hands_summary(found.tracks), found.notes, picture)


def hand_source(request: PreprocessRequest) -> tuple[str, Path] | None:
    """The option and the file that the hands come from; None for the artefact that is there.

    Raises:
        InputError: several are given, there is no such file, or there is nothing at all.
    """
    sources = {
        "--keypoints": request.keypoints,
        "--hands": request.hands,
        "--landmarker": request.landmarker,
    }
    given = [(name, value) for name, value in sources.items() if value is not None]
    if len(given) > 1:
        found = " and ".join(name for name, _ in given)
        raise InputError(f"hands: expected one of {', '.join(sources)}, found {found}")
    if not given:
        file = request.processed / HANDS_FILE
        if not file.exists():
            raise InputError(
                f"{file}: expected estimates of the hands, found none; give --keypoints FILE (21 points "
                f"of each "
                "hand), or --hands FILE of another hand estimator"
            )
        return None
    option, source = given[0]
    if not source.exists():
        raise InputError(f"{source}: expected a file for {option}, found {found_at(source)}")
    return option, source


def build_step(request: PreprocessRequest, listen: Listen) -> StepOutcome:
    """`CLIP/build` from all artefacts."""
    processed = request.processed
    frames = read_frame_set(processed)
    count = len(frames.names)
    stamp, picture = processed / BUILD_FILE, processed / "build.png"
    parts = [processed / name for name in (FRAMES_FILE, MASKS, HANDS_FILE, SFM_FILE, ALIGNED_FILE)]
    config = SurfacePointsConfig()
    inputs = content_digest(*parts, frames.K, _model_identity(request), asdict(config))
    ours = stamp.exists()
    if request.state(stamp, inputs) == "current" and (request.clip / "build" / "data.npy").is_file():
        return kept("build", "current", str(request.clip / "build"), picture)
    models = load_hand_models(request.hand_model)
    paths = frame_paths(processed, frames)
    masks = np.stack([read_mask(path) for path in mask_paths(processed, frames)])
    sfm = read_object_sfm(processed / SFM_FILE, count)
    alignment = read_alignment(processed / ALIGNED_FILE, count)
    listen("points where silhouettes determine the surface")
    completed = complete_points(sfm, alignment, lambda t: read_image(paths[t]), masks, frames.K, config)
    build = write_build(
        request.clip,
        name=request.clip.resolve().name,
        frame_names=frames.names,
        images=(read_image(path) for path in paths),
        masks=masks,
        K=frames.K,
        hands=read_hands(processed / HANDS_FILE, count),
        hand_models=models,
        sfm=completed,
        alignment=alignment,
        fps=frames.fps,
        ours=ours,
    )
    clip = load_hold(build)
    write_json(stamp, {"build": str(build)}, inputs)
    write_sheet(picture, paths, frames.names, draw_clip(clip, models))
    summary = f"{build}, {len(completed.points)} points of the object ({len(sfm.points)} from its motion)"
    return StepOutcome("build", "made", summary, (), picture)


def check_mask_source(request: PreprocessRequest) -> None:
    """Whether there is anything that masks can come from.

    Raises:
        InputError: nothing was given and nothing is there, or what was given is no folder.
    """
    made = request.processed / MASKS
    if request.masks is not None and not request.masks.is_dir():
        raise InputError(f"{request.masks}: expected a folder of masks, found {found_at(request.masks)}")
    if request.masks is None and request.sam2 is None and not made.is_dir():
        raise InputError(
            f"{made}: expected masks of hands and object, found none; give --masks DIR, "
            "or --sam2 DIR with --clicks FILE (bigs preprocess frames extracts the frames alone)"
        )


def _supplied_masks(request: PreprocessRequest, frames: FrameSet, picture: Path) -> StepOutcome:
    """Masks of an earlier run, or that another tool put in their place: looked at, and kept as they are."""
    processed = request.processed
    file = processed / MASKS_FILE
    if file.exists():
        mask_paths(processed, frames)
        return StepOutcome("masks", "supplied", "as they are", read_notes(file), None)
    check_mask_source(request)
    return _adopt_masks(processed, frames, picture)


def _given_masks(request: PreprocessRequest, frames: FrameSet) -> tuple[str, Callable[[], MaskSource]]:
    """Digest and maker of the masks of a folder."""
    folder = request.masks
    if request.sam2 is not None or request.clicks is not None:
        raise InputError("masks: expected --masks, or --sam2 with --clicks, found both")
    if folder is None or not folder.is_dir():
        found = "a file" if folder is not None and folder.exists() else "nothing"
        raise InputError(f"{folder}: expected a folder of masks, found {found}")
    inputs = content_digest(folder, request.mask_labels, _frame_identity(frames))
    return inputs, lambda: open_masks(folder, frames, request.mask_labels)


def _sam2_masks(
    request: PreprocessRequest, frames: FrameSet, listen: Listen
) -> tuple[str, Callable[[], MaskSource]]:
    """Digest and maker of the masks that SAM 2 makes of clicks and, for hands without, of keypoints."""
    folder, processed = request.sam2, request.processed
    if request.mask_labels:
        raise InputError("--mask-labels: expected --masks with it, found --sam2")
    if folder is None or not folder.is_dir():
        raise InputError(no_weights(folder))
    if request.clicks is None:
        raise InputError("--sam2: expected --clicks FILE with a click or a box on the object, found none")
    clicks = read_clicks(request.clicks, frames)
    if request.keypoints is not None:
        clicks = add_hand_clicks(clicks, read_keypoints(request.keypoints, frames), frames)
    if "object" not in clicks:
        raise InputError(
            f"{request.clicks}: expected a click or a box on the object, found {', '.join(clicks)}"
        )
    parts = [folder, request.clicks, processed / FRAMES_FILE, processed / FRAMES]
    inputs = content_digest(*parts, *([request.keypoints] if request.keypoints else []))

    def make() -> MaskSource:
        listen("loading SAM 2")
        size = (frames.width, frames.height)
        masks = segment_clip(load_sam2(folder), frame_paths(processed, frames), size, clicks, listen)
        return MaskSource(lambda t: (masks[t], 0), f"SAM 2, clicks on {', '.join(clicks)}")

    return inputs, make


def _adopt_masks(processed: Path, frames: FrameSet, picture: Path) -> StepOutcome:
    """Masks that another tool put in their place: looked at, and kept as they are."""
    masks = [read_mask(path, (frames.width, frames.height)) for path in mask_paths(processed, frames)]
    notes = tuple(check_masks(masks, [0] * len(masks), frames.names))
    write_json(processed / MASKS_FILE, {"notes": notes}, "")
    _draw_masks(picture, processed, frames, masks)
    return StepOutcome("masks", "supplied", "as they are", notes, picture)


def _frame_identity(frames: FrameSet) -> dict[str, object]:
    """What of the frames decides which mask or keypoint belongs to which frame, and at what size."""
    return {
        key: value
        for key, value in asdict(frames).items()
        if key in ("names", "width", "height", "fps", "source_frames", "source_length", "source_size")
    }


def _model_identity(request: PreprocessRequest) -> Path | str:
    return "built-in" if request.hand_model is None else request.hand_model


def _frames_summary(frames: FrameSet) -> str:
    text = f"{len(frames.names)} of {frames.width} x {frames.height} at {frames.fps:.3g} a second"
    return f"{text}, focal length {frames.K[0, 0]:.0f} pixels ({frames.camera})"


def _hands_summary(hands: dict[Side, HandTrack]) -> str:
    parts = []
    for side, track in hands.items():
        text = f"{side} in {int(track.valid.sum())} of {len(track.valid)} frames"
        if not track.valid.all():
            text += f" (filled in {frame_ranges(~track.valid)})"
        parts.append(text)
    return ", ".join(parts)


def _draw_masks(picture: Path, processed: Path, frames: FrameSet, masks: list[np.ndarray]) -> None:
    write_sheet(
        picture, frame_paths(processed, frames), frames.names, lambda t, image: tinted(image, masks[t])
    )


def _draw_hands(
    picture: Path, processed: Path, frames: FrameSet, found: HandEstimates, models: dict[Side, HandModel]
) -> None:
    joints = {side: joints_of_track(track, models[side]) for side, track in found.tracks.items()}

    def draw(t: int, image: np.ndarray) -> np.ndarray:
        valid = {side: bool(track.valid[t]) for side, track in found.tracks.items()}
        return with_skeletons(image, {side: points[t] for side, points in joints.items()}, valid, frames.K)

    write_sheet(picture, frame_paths(processed, frames), frames.names, draw)
