"""Right and left hands are mirror images in the plane x = 0: points, rotations and shapes across it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bigs.checks import InputError

if TYPE_CHECKING:
    from bigs.hand.model import HandModel


def mirror_points(points: Tensor) -> Tensor:
    """Points or vectors [..., 3] with x negated."""
    return points * points.new_tensor([-1.0, 1.0, 1.0])


def mirror_axis_angle(axis_angle: Tensor) -> Tensor:
    """Rotation vectors [..., 3] as the mirror shows them: (x, y, z) to (x, -y, -z)."""
    return axis_angle * axis_angle.new_tensor([1.0, -1.0, -1.0])


def mirror_rotation(matrices: Tensor) -> Tensor:
    """Matrices [..., 3, 3] as the mirror shows them: S R S with S = diag(-1, 1, 1)."""
    signs = matrices.new_tensor([-1.0, 1.0, 1.0])
    return matrices * signs[:, None] * signs


def shared_betas(right: HandModel, left: HandModel, betas_left: Tensor) -> Tensor:
    """The right hand's shape whose mirror image is nearest to the left model's shape `betas_left`.

    Nearest in least squares over vertices relative to the wrist joint, since a posed hand is placed by its
    wrist. When the left file is the mirrored right file this is `betas_left` itself. MANO_LEFT has the x part
    of its shape directions with the right hand's sign; ARCTIC's and HOLD's shapes were fitted to it as it is,
    so the sign is not corrected: this gives the right hand's shape that looks most like what they fitted.

    Args:
        right: a right hand.
        left: a left hand with the same vertices in the same order.
        betas_left: [10].

    Returns:
        [10], of the dtype of `betas_left`.

    Raises:
        InputError: the two models have different vertex counts.
    """
    if right.v_template.shape != left.v_template.shape:
        raise InputError(
            "hand models: expected right and left models with the same vertices, "
            f"found {len(right.v_template)} and {len(left.v_template)}"
        )
    directions = _relative_to_wrist(right, right.shapedirs.double().permute(2, 0, 1))
    wanted = _relative_to_wrist(left, left.rest_vertices(betas_left.to(left.v_template)).double())
    residual = mirror_points(wanted) - _relative_to_wrist(right, right.v_template.double())
    solution = torch.linalg.lstsq(directions.flatten(1).T, residual.reshape(-1, 1)).solution[:, 0]
    return solution.to(betas_left)


def _relative_to_wrist(model: HandModel, points: Tensor) -> Tensor:
    """Vertex-shaped data [..., V, 3] minus what the regressor makes of it at joint 0."""
    return points - model.J_regressor[:1].double() @ points
