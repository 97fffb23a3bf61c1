"""Taking a projection matrix apart into the camera that made it."""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from bigs.checks import InputError

# Projections are stored as float32, so a camera is known to about seven digits.
CAMERA_TOLERANCE = 1e-4
# A focal length below this fraction of the image width sees more than 179.8 degrees: a broken file.
_MIN_FOCAL = 1e-3


def decompose_projection(where: str, projection: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Split a projection into intrinsics and a rigid motion.

    Args:
        where: what to call it in messages.
        projection: [4, 4], K [R | t] up to a positive factor over the row (0, 0, 0, 1).
        width: of the images, pixels; it says what focal length is absurd.

    Returns:
        K [3, 3] and cam_from_world [4, 4].

    Raises:
        InputError: there is no such K, R and t.
    """
    depth_scale = np.linalg.norm(projection[2, :3])
    if depth_scale == 0 or not np.allclose(projection[3], [0, 0, 0, 1]):
        raise InputError(
            f"{where}: expected the last rows to be a viewing direction and (0, 0, 0, 1), "
            f"found {projection[2:].tolist()}"
        )
    projection = projection[:3] / depth_scale
    K, R = rq(projection[:, :3])
    signs = np.sign(np.diag(K))
    signs[signs == 0] = 1
    K, R = K * signs, signs[:, None] * R
    focal = K[[0, 1], [0, 1]]
    if focal.min() < _MIN_FOCAL * width:
        raise InputError(
            f"{where}: expected positive focal lengths, found {focal[0]:.3g} and {focal[1]:.3g} pixels"
        )
    if np.linalg.det(R) < 0:
        raise InputError(
            f"{where}: expected K times a rigid motion, found a mirrored one (negative determinant)"
        )
    if abs(K[0, 1]) > CAMERA_TOLERANCE * width:
        raise InputError(
            f"{where}: expected K without skew times a rigid motion, found a skew of {K[0, 1]:.3g} pixels"
        )
    K[0, 1] = 0.0
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = R
    cam_from_world[:3, 3] = np.linalg.solve(K, projection[:, 3])
    return K, cam_from_world
