"""The last step: artefacts become the `build` folder that HOLD and `bigs reconstruct` read."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.base import HandTrack, ObjectTrack
from bigs.data.formats.hold import GL_FROM_CV, write_hold
from bigs.hand import HandModel
from bigs.preprocess.artefacts import Alignment, ObjectSfm
from bigs.types import Side


def scene_shift(sfm: ObjectSfm, alignment: Alignment) -> np.ndarray:
    """HOLD's `normalize_shift` [3], which puts the object one metre before its world's origin."""
    metric = alignment.scale * sfm.points
    medians = [
        np.median(metric @ rotation.T + transl, axis=0)
        for rotation, transl in zip(alignment.object_rotations, alignment.object_transl, strict=True)
    ]
    return -GL_FROM_CV @ np.median(medians, axis=0) + np.array([0.0, 0.0, -1.0])


def hand_in_world(track: HandTrack, transl: np.ndarray, model: HandModel, shift: np.ndarray) -> HandTrack:
    """A hand of the camera frame in HOLD's world, x_world = F x_cam + shift.

    Args:
        track: pose and shape in the camera frame.
        transl: [T, 3] aligned translation in the camera frame, metres.
        model: that side's own model, about whose rest wrist the hand turns.
        shift: [3] metres.
    """
    betas = model.v_template.new_tensor(track.betas)
    wrist = model.rest_joints(betas)[0].double().numpy()
    turns = Rotation.from_rotvec(track.global_orient).as_matrix()
    return HandTrack(
        global_orient=Rotation.from_matrix(GL_FROM_CV @ turns).as_rotvec(),
        hand_pose=track.hand_pose,
        transl=(wrist + transl) @ GL_FROM_CV - wrist + shift,
        betas=track.betas,
        valid=track.valid,
    )


def object_in_world(sfm: ObjectSfm, alignment: Alignment, shift: np.ndarray) -> ObjectTrack:
    """The object of the camera frame in HOLD's world, its points normalised."""
    scale = alignment.scale
    return ObjectTrack(
        points=sfm.points @ sfm.norm_mat[:3, :3].T + sfm.norm_mat[:3, 3],
        colors=sfm.colors / 255.0,
        scale=scale,
        metric_from_canon=np.diag([scale, scale, scale, 1.0]) @ np.linalg.inv(sfm.norm_mat),
        rotations=GL_FROM_CV @ alignment.object_rotations,
        transl=alignment.object_transl @ GL_FROM_CV + shift,
        valid=alignment.object_valid,
    )


def write_build(
    clip: Path,
    *,
    name: str,
    frame_names: Sequence[str],
    images: Iterable[np.ndarray],
    masks: Iterable[np.ndarray],
    K: np.ndarray,
    hands: Mapping[Side, HandTrack],
    hand_models: Mapping[Side, HandModel],
    sfm: ObjectSfm,
    alignment: Alignment,
    fps: float,
    ours: bool,
) -> Path:
    """Write `clip/build`; the folder is whole or as it was.

    Args:
        clip: the clip folder.
        name: sequence name.
        frame_names: T original names.
        images: T images [H, W, 3] uint8.
        masks: T label images [H, W] uint8.
        K: [3, 3].
        hands: tracks in the camera frame.
        hand_models: both sides' models.
        sfm: the object's points.
        alignment: where everything is in metres.
        fps: frames a second.
        ours: a `build` folder that is there was made by this function and may be replaced.

    Raises:
        InputError: there is a `build` folder of other origin.
    """
    build = clip / "build"
    if build.exists() and not ours:
        raise InputError(
            f"{build}: expected no folder or one that bigs made, found another; "
            "move it away or choose another --out"
        )
    shift = scene_shift(sfm, alignment)
    scratch = clip / "processed" / ".build.part"
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        write_hold(
            scratch,
            name=name,
            frame_names=frame_names,
            images=images,
            masks=masks,
            K=K,
            normalize_shift=shift,
            hands={
                side: hand_in_world(
                    track, alignment.hand_transl.get(side, track.transl), hand_models[side], shift
                )
                for side, track in hands.items()
            },
            object=object_in_world(sfm, alignment, shift),
            fps=fps,
        )
        shutil.rmtree(build, ignore_errors=True)
        os.replace(scratch / "build", build)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return build
