"""Pose scores: joints relative to the wrist, where the wrist is, and how the object is turned."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bigs.checks import check_shape
from bigs.geometry.rotations import robust_mean_rotation


def mpjpe(pred: np.ndarray, gt: np.ndarray) -> np.ndarray:
    """Mean per-joint position error of each frame, each side relative to its own joint 0.

    The root counts as one of the joints, with error 0, as the ARCTIC and HO-3D evaluators have it.

    Args:
        pred: joints [T, 21, 3], metres.
        gt: joints [T, 21, 3], metres.

    Returns:
        [T] millimetres.

    Raises:
        InputError: another shape.
    """
    _check_joints(pred, gt)
    relative = (pred - pred[:, :1]) - (gt - gt[:, :1])
    return 1000.0 * np.linalg.norm(relative, axis=-1).mean(axis=-1)


def clip_scale(pred_points: np.ndarray, gt_points: np.ndarray) -> float:
    """The one scale about the camera centre that a clip is allowed before positions are compared.

    A single camera cannot tell a small near scene from a large far one, so the least-squares scale argmin_s
    sum |s pred - gt|² over corresponding points is taken out. It is a property of the whole clip: give it the
    points of all frames together.

    Args:
        pred_points: [..., 3] metres, camera frame.
        gt_points: [..., 3] metres, camera frame. Points that are not finite on either side are left out.

    Returns:
        The scale, 1 when no finite point is left.

    Raises:
        InputError: another shape.
    """
    check_shape("pred_points", pred_points, ("...", 3))
    check_shape("gt_points", gt_points, pred_points.shape)
    finite = np.isfinite(pred_points).all(axis=-1) & np.isfinite(gt_points).all(axis=-1)
    pred, gt = pred_points[finite].astype(np.float64), gt_points[finite].astype(np.float64)
    energy = float(np.sum(pred * pred))
    return float(np.sum(pred * gt)) / energy if energy > 0.0 else 1.0


def wrist_error(pred: np.ndarray, gt: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Distance between the wrists of each frame after the clip's scale.

    Args:
        pred: joints [T, 21, 3], metres, camera frame.
        gt: joints [T, 21, 3], metres, camera frame.
        scale: multiplies `pred`, see `clip_scale`.

    Returns:
        [T] millimetres.

    Raises:
        InputError: another shape.
    """
    _check_joints(pred, gt)
    return 1000.0 * np.linalg.norm(scale * pred[:, 0] - gt[:, 0], axis=-1)


def turn_errors(pred: np.ndarray, gt: np.ndarray) -> np.ndarray:
    """Error of a rigid object's rotation in each frame, after one turn of its own frame for the whole clip.

    That turn is the one on which the frames agree, since two reconstructions of an object share no axes.

    Args:
        pred: vertices [T, N, 3], the same in each frame, metres, camera frame.
        gt: vertices [T, M, 3], likewise; any other mesh.

    Returns:
        [T] degrees; NaN where a side is not finite.

    Raises:
        InputError: another shape.
    """
    check_shape("pred", pred, ("T", "N", 3))
    check_shape("gt", gt, (len(pred), "M", 3))
    degrees = np.full(len(pred), np.nan)
    known = np.flatnonzero(np.isfinite(pred).all(axis=(1, 2)) & np.isfinite(gt).all(axis=(1, 2)))
    if len(known):
        between = _turns(pred[known]).transpose(0, 2, 1) @ _turns(gt[known])
        usual = robust_mean_rotation(torch.from_numpy(between)).numpy()
        degrees[known] = np.degrees(Rotation.from_matrix(between @ usual.T).magnitude())
    return degrees


def _turns(verts: np.ndarray) -> np.ndarray:
    """Rotations [T, 3, 3] of vertices [T, N, 3] since the first frame, by least squares."""
    about = verts.astype(np.float64) - verts.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(about.transpose(0, 2, 1) @ about[0])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def _check_joints(pred: np.ndarray, gt: np.ndarray) -> None:
    check_shape("pred", pred, ("T", "J", 3))
    check_shape("gt", gt, pred.shape)
