"""Between torch and the compiled code."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def array(tensor: Tensor) -> np.ndarray:
    """A numpy view of a tensor; copies only what is not contiguous."""
    return tensor.detach().contiguous().numpy()


def array_or_none(tensor: Tensor | None) -> np.ndarray | None:
    """The same where there may be nothing."""
    return None if tensor is None else array(tensor)


def shaped(values: np.ndarray, like: Tensor) -> Tensor:
    """Flat values in the shape of a tensor."""
    return torch.from_numpy(values.reshape(like.shape))
