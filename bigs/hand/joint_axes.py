"""Which way the joints of a hand cannot turn, from its rest pose alone.

The two outer joints of a finger are hinges: they bend about the axis across the finger, and nothing else. A
finger's base joint bends and spreads, but no muscle turns it about its own bone; nor the thumb's two outer
joints. Only the thumb's saddle joint turns all ways. `bends` tells how far the hinges are bent.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.hand.model import HandModel

# MANO's tips in the order of its fingers, which are index, middle, pinky, ring and thumb.
_TIP_OF_FINGER = (1, 2, 4, 3, 0)
_THUMB = 4
# Away from the palm in MANO's rest pose.
_BACK = (0.0, 1.0, 0.0)


def impossible_turns(model: HandModel) -> Tensor:
    """Linear functions of finger rotations, each the sine of a turn that a joint cannot make.

    Returns:
        [22, 15, 3, 3] coefficients; the sum of their products with rotations [15, 3, 3] is zero for a pose in
        which every joint turns as it can.
    """
    rows = []
    for joint, (bone, hinge) in enumerate(_bones_and_hinges(model)):
        finger, place = divmod(joint, 3)
        if finger != _THUMB and place > 0:
            # Where a turn about the bone, or sideways, carries the hinge.
            aside = torch.linalg.cross(hinge, bone)
            rows += [_row(joint, torch.outer(to, hinge)) for to in (aside, bone)]
        elif finger != _THUMB or place > 0:
            rows.append(_row(joint, 0.5 * _cross_matrix(bone)))
    return torch.stack(rows)


def bends(model: HandModel) -> Tensor:
    """Linear functions of finger rotations: sine and cosine of the angles by which the hinges bend.

    Returns:
        [2, 2, 4, 15, 3, 3]: sine and cosine, of the middle joints and the outermost ones, of the four
        fingers without the thumb.
    """
    found = _bones_and_hinges(model)
    hinges = [(joint, *found[joint]) for place in (1, 2) for joint in range(place, 3 * _THUMB, 3)]
    # The bone goes along itself, and at right angles to it and the hinge.
    sines = [_row(joint, torch.outer(torch.linalg.cross(hinge, bone), bone)) for joint, bone, hinge in hinges]
    cosines = [_row(joint, torch.outer(bone, bone)) for joint, bone, _ in hinges]
    return torch.stack([*sines, *cosines]).reshape(2, 2, _THUMB, 15, 3, 3)


def _bones_and_hinges(model: HandModel) -> list[tuple[Tensor, Tensor]]:
    """Directions [3] of the bone that each joint moves, and across it in the flat hand."""
    rest_joints, tips = model.J_regressor @ model.v_template, model.v_template[model.tip_vertex_ids]
    back = rest_joints.new_tensor(_BACK)
    found = []
    for finger, tip in enumerate(_TIP_OF_FINGER):
        chain = torch.cat([rest_joints[1 + 3 * finger : 4 + 3 * finger], tips[tip : tip + 1]])
        for bone in torch.nn.functional.normalize(chain.diff(dim=0), dim=-1):
            hinge = torch.nn.functional.normalize(torch.linalg.cross(bone, back), dim=0)
            found.append((bone, hinge))
    return found


def _row(joint: int, coefficients: Tensor) -> Tensor:
    row = coefficients.new_zeros(15, 3, 3)
    row[joint] = coefficients
    return row


def _cross_matrix(axis: Tensor) -> Tensor:
    """[3, 3] of the product axis x v, half of which takes a rotation's turn about the axis out of it."""
    x, y, z = axis.tolist()
    return axis.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
