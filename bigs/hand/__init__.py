"""Hands in MANO form: model files, skinning, mirroring, and a built-in hand that needs no file."""

from bigs.hand.builtin import builtin_hand
from bigs.hand.io import load_hand_model, load_hand_models
from bigs.hand.joint_axes import bends, impossible_turns
from bigs.hand.lbs import blend_transforms, skin_points
from bigs.hand.mirror import mirror_axis_angle, mirror_points, mirror_rotation, shared_betas
from bigs.hand.model import JOINT_NAMES, MANO_PARENTS, HandModel, HandOutput, Skeleton

__all__ = [
    "JOINT_NAMES",
    "MANO_PARENTS",
    "HandModel",
    "HandOutput",
    "Skeleton",
    "bends",
    "blend_transforms",
    "builtin_hand",
    "impossible_turns",
    "load_hand_model",
    "load_hand_models",
    "mirror_axis_angle",
    "mirror_points",
    "mirror_rotation",
    "shared_betas",
    "skin_points",
]
