"""The built-in hand, so that everything runs without a model file.

Joint tree, axes and number of shapes as in a MANO-format file; no pose correctives, flat mean pose. The
repository's `tools/builtin_hand` makes its arrays.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bigs.hand.model import MANO_PARENTS, HandModel
from bigs.types import Side

FILE = Path(__file__).with_name("builtin_hand.npz")


def builtin_hand(side: Side = "right") -> HandModel:
    """The built-in hand; the left one is the mirrored right one."""
    with np.load(FILE, allow_pickle=False) as stored:
        arrays = dict(stored)
    posedirs = np.zeros((*arrays["v_template"].shape, 9 * (len(MANO_PARENTS) - 1)), dtype=np.float32)
    right = HandModel("right", posedirs=posedirs, **arrays)
    return right if side == "right" else right.mirrored()
