"""Poses as other programs expect them: MANO layers (smplx, manopth) and ARCTIC's annotation files."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bigs.atomic import atomic_write
from bigs.checks import check_finite
from bigs.export.poses import ClipPoses
from bigs.geometry.rotations import matrix_to_axis_angle
from bigs.types import Side


def save_mano(
    path: str | Path,
    poses: ClipPoses,
    flat_hand_pose: Mapping[Side, np.ndarray],
    joints: Mapping[Side, np.ndarray],
) -> None:
    """Write the hands as parameters of a MANO layer; `path` is whole or absent.

    For each side `SIDE_global_orient` [T, 3], `SIDE_hand_pose` [T, 45] (for flat_hand_mean=False),
    `SIDE_hand_pose_flat` [T, 45] (for flat_hand_mean=True), `SIDE_betas` [10], `SIDE_transl` [T, 3] and
    `SIDE_joints` [T, 21, 3], with `K`, `frame_names` and `joint_order`: axis-angle, metres, OpenCV camera
    axes, each side in its own convention, the left hand's shape directions as a mirrored right model has
    them. `use_pca` is off.

    Args:
        path: the .npz file.
        poses: the clip's poses; the object is left out.
        flat_hand_pose: [T, 15, 3] full finger rotations, axis-angle.
        joints: [T, 21, 3].
    """
    arrays: dict[str, Any] = {
        "frame_names": np.array(poses.frame_names),
        "K": poses.K,
        "joint_order": np.array("16 joints as MANO has them, then tips of thumb, index, middle, ring, pinky"),
    }
    for side, hand in poses.hands.items():
        arrays |= {
            f"{side}_global_orient": hand.global_orient,
            f"{side}_hand_pose": hand.hand_pose.reshape(-1, 45),
            f"{side}_hand_pose_flat": flat_hand_pose[side].reshape(-1, 45),
            f"{side}_betas": hand.betas,
            f"{side}_transl": hand.transl,
            f"{side}_joints": joints[side],
        }
    _save(path, arrays)


def save_arctic(path: str | Path, poses: ClipPoses, *, width: int, height: int) -> None:
    """Write the poses under the names and in the units of ARCTIC's raw sequences; `path` is whole or absent.

    `SIDE_rot` [T, 3], `SIDE_pose` [T, 45] (relative to the mean), `SIDE_trans` [T, 3] metres and `SIDE_shape`
    [10] are the entries of `SEQ.mano.npy`. `object` [T, 7] is `SEQ.object.npy`: articulation in radians
    (always 0 here), axis-angle, translation in **millimetres**, of an object scaled by `object_scale`.
    `world2cam` [4, 4] (the identity, since all is in camera space), `intris_mat` [3, 3] and `image_size` [2]
    are those of `misc.json`.

    Args:
        path: the .npz file.
        poses: the clip's poses.
        width, height: of the images, pixels.
    """
    arrays: dict[str, Any] = {
        "frame_names": np.array(poses.frame_names),
        "world2cam": np.eye(4),
        "intris_mat": poses.K,
        "image_size": np.array([width, height]),
    }
    for side, hand in poses.hands.items():
        arrays |= {
            f"{side}_rot": hand.global_orient,
            f"{side}_pose": hand.hand_pose.reshape(-1, 45),
            f"{side}_trans": hand.transl,
            f"{side}_shape": hand.betas,
        }
    if poses.object is not None:
        turns = matrix_to_axis_angle(torch.as_tensor(poses.object.rotations)).numpy()
        articulation = np.zeros((len(turns), 1))
        arrays["object"] = np.concatenate([articulation, turns, 1000.0 * poses.object.transl], axis=1)
        arrays["object_scale"] = np.array(poses.object.scale)
    _save(path, arrays)


def _save(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    for name, values in arrays.items():
        if values.dtype.kind == "f":
            check_finite(f"{path}: {name}", values)
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    with atomic_write(path) as file:
        file.write(content.getbuffer())
