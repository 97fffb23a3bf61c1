"""Arrays as tensors."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor


def float32(array: ArrayLike) -> Tensor:
    """A float32 tensor of an array's values; it may share memory with a contiguous float32 array."""
    return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)
