"""Make `bigs/hand/builtin_hand.npz` anew: `python -m tools.builtin_hand` in the root of the repository."""

from __future__ import annotations

import numpy as np

from bigs.atomic import atomic_write
from bigs.hand.builtin import FILE
from tools.builtin_hand.arrays import right_hand_arrays


def main() -> None:
    arrays = {
        name: values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
        for name, values in right_hand_arrays().items()
    }
    with atomic_write(FILE) as file:
        np.savez_compressed(file, **arrays)


if __name__ == "__main__":
    main()
