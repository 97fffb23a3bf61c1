"""Conversion of clips of any layout, with their ground truth, into HOLD's build folder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from PIL import Image

from bigs.checks import InputError, check_positive
from bigs.commands.clips.open import open_clip
from bigs.commands.clips.truth import pose_annotation, read_annotation
from bigs.data.base import Clip
from bigs.data.decoded import DecodedFrames
from bigs.data.excerpt import excerpt
from bigs.data.formats.annotation import Annotation
from bigs.data.formats.hold import GL_FROM_CV, write_hold
from bigs.data.ground_truth import write_ground_truth
from bigs.data.images import MASK_SUFFIXES, check_pairs, list_frames
from bigs.data.limited_view import limited_frames, object_directions
from bigs.data.moving import in_world, move_hand, move_object
from bigs.hand import HandModel, load_hand_models
from bigs.types import Side

View = Literal["full", "limited"]


@dataclass(frozen=True)
class ConvertPlan:
    """What to make of a clip."""

    view: View = "full"  # limited: a quarter of the frames that shows the object from few sides
    every: int = 1  # keep every Nth frame
    fps: float | None = None  # frames a second of the clip; None believes its files
    width: int = 0  # width of the images; 0 keeps theirs
    masks: Path | None = None  # label masks named like the images; the clip's own by default
    from_truth: bool = False  # start from a data set's ground truth


def convert(
    source: Path, out: Path, plan: ConvertPlan, hand_model: Path | None = None
) -> list[tuple[str, str]]:
    """Write a clip of any layout as a build folder; a data set's truth goes into gt.npz beside it.

    Frames that a data set does not annotate are left out.

    Args:
        source: the clip.
        out: folder to make; must not hold a clip.
        plan: what to make of it.
        hand_model: MANO-format models that the data set's poses were fitted with; None takes the built-in.

    Returns:
        What was done, as rows of text.

    Raises:
        InputError: the clip is invalid, has no masks, or holds the truth, which is only
            taken as a start when asked for.
    """
    if (out / "build").exists():
        raise InputError(f"{out / 'build'}: expected no clip there yet, found one")
    if plan.every < 1 or plan.width < 0:
        raise InputError(f"--every, --width: expected at least 1 and 0, found {plan.every} and {plan.width}")
    if plan.fps is not None:
        check_positive("--fps", plan.fps)
    hand_models = load_hand_models(hand_model)
    clip = open_clip(source, hand_models)
    if clip.annotated and not plan.from_truth:
        raise InputError(
            f"{source}: expected a clip with initial estimates, found a data set's ground truth "
            "(bigs preprocess makes estimates from its images; "
            "--from-truth starts from the truth, to study what follows)"
        )
    if plan.masks is not None:
        masks = list_frames(plan.masks, MASK_SUFFIXES)
        check_pairs(clip.image_paths, masks)
        size = (clip.width, clip.height) if clip.optics is None else clip.optics.file_size
        areas = DecodedFrames().read_all((), masks, size)
        clip = replace(clip, mask_paths=masks, mask_areas=areas, swapped=None, arms=None)
    if not clip.mask_paths:
        raise InputError(f"{source}: expected label masks (--masks), found none")
    clip, notes = _chosen(clip, plan)
    truth = read_annotation(source, clip.frame_names, hand_models) if clip.annotated else None
    size, K = _resized(clip.width, clip.height, clip.K, plan.width)
    write_build_clip(clip, out, hand_models, K, _pictures(clip, size), _labels(clip, size))
    if truth is not None:
        notes += _write_truth(truth, out, hand_models, plan.width)
    return [("clip", f"{clip.name}: {len(clip)} frames in {out}"), *notes]


def _chosen(clip: Clip, plan: ConvertPlan) -> tuple[Clip, list[tuple[str, str]]]:
    """The clip's frames that the plan wants."""
    known = np.ones(len(clip), dtype=bool)
    if clip.annotated:
        valid = [hand.valid for hand in clip.hands.values()]
        known = np.all(valid if clip.object is None else [*valid, clip.object.valid], axis=0)
    frames = np.flatnonzero(known)[:: plan.every]
    notes = [("left out", f"{int((~known).sum())} frames without annotation")] if not known.all() else []
    if plan.view == "limited":
        if clip.object is None:
            raise InputError(f"{clip.folder}: expected an object for the limited view, found none")
        chosen, reach = limited_frames(object_directions(clip)[frames])
        frames = frames[chosen]
        notes.append(("view", f"limited: directions within {np.degrees(reach):.0f} degrees of one"))
    rate = clip.fps if plan.fps is None else plan.fps
    return replace(excerpt(clip, frames), fps=rate / plan.every), notes


def write_build_clip(
    clip: Clip,
    out: Path,
    hand_models: Mapping[Side, HandModel],
    K: np.ndarray,
    images: Iterable[np.ndarray],
    masks: Iterable[np.ndarray],
) -> Path:
    """Write a clip with its tracks in HOLD's world, which is the camera turned over and shifted.

    Args:
        clip: whose tracks, camera motion and names are written.
        out: folder that gets `build`.
        hand_models: those of its tracks.
        K: [3, 3] of the pictures.
        images: T pictures [H, W, 3] uint8.
        masks: T labels [H, W] uint8 with the values of `bigs.types.MASK_VALUES`.

    Returns:
        The build folder.
    """
    hold_from_cam = np.eye(4)
    hold_from_cam[:3, :3], hold_from_cam[:3, 3] = GL_FROM_CV, clip.normalize_shift
    motions = hold_from_cam @ clip.cam_from_world
    return write_hold(
        out,
        name=clip.name,
        frame_names=clip.frame_names,
        images=images,
        masks=masks,
        K=K,
        normalize_shift=clip.normalize_shift,
        hands={
            side: move_hand(track, motions, hand_models[side].rest_wrist(track.betas))
            for side, track in clip.hands.items()
        },
        object=None if clip.object is None else move_object(clip.object, motions),
        fps=clip.fps,
    )


def _write_truth(
    truth: Annotation, out: Path, hand_models: Mapping[Side, HandModel], width: int
) -> list[tuple[str, str]]:
    in_camera = in_world(
        truth,
        truth.cam_from_world,
        {side: hand_models[side].rest_wrist(track.betas) for side, track in truth.hands.items()},
    )
    size, K = _resized(truth.width, truth.height, truth.K, width)
    posed = pose_annotation(truth, hand_models)
    arrays: dict[str, Any] = {"K": K, "wh": np.array(size)}
    for side, track in in_camera.hands.items():
        poses = np.concatenate([track.global_orient[:, None], track.hand_pose], axis=1)
        fields = {
            "pose": poses.reshape(-1, 48),
            "betas": track.betas,
            "trans": track.transl,
            "verts": posed.verts[side],
            "joints": posed.joints[side],
            "faces": posed.faces[side],
        }
        arrays |= {f"{side}_{key}": values for key, values in fields.items()}
    obj, mesh = in_camera.object, None
    bends = obj is not None and obj.verts.ndim == 3
    if obj is not None and not bends:
        arrays |= {"obj_R": obj.rotations, "obj_t": obj.transl, "obj_scale": 1.0}
        mesh = trimesh.Trimesh(obj.verts, obj.faces, process=False)
    write_ground_truth(out, arrays=arrays, object_mesh=mesh)
    notes = [("truth", str(out / "gt.npz"))]
    if bends:
        notes.append(("object", "it bends, so gt.npz has the hands only; score against the data set itself"))
    return notes


def _resized(width: int, height: int, K: np.ndarray, wanted: int) -> tuple[tuple[int, int], np.ndarray]:
    """The size of images `wanted` pixels wide, and their K: pixel centres at +0.5 leave no other term."""
    if not wanted:
        return (width, height), K
    size = (wanted, round(height * wanted / width))
    return size, np.diag([size[0] / width, size[1] / height, 1.0]) @ K


def _pictures(clip: Clip, size: tuple[int, int]) -> Iterator[np.ndarray]:
    for t in range(len(clip)):
        # Whatever opens the new clip brings it to one exposure again.
        image = clip.image_as_taken(t)
        yield image if size == (clip.width, clip.height) else _scaled(image, size, Image.Resampling.BOX)


def _labels(clip: Clip, size: tuple[int, int]) -> Iterator[np.ndarray]:
    for t in range(len(clip)):
        mask = clip.mask_with_arms(t)
        yield mask if size == (clip.width, clip.height) else _scaled(mask, size, Image.Resampling.NEAREST)


def _scaled(pixels: np.ndarray, size: tuple[int, int], method: Image.Resampling) -> np.ndarray:
    return np.asarray(Image.fromarray(pixels).resize(size, method))
