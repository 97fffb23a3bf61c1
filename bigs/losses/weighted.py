"""A loss is a dict of named terms and a dict of weights."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor


def weighted_sum(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Sum of weight * term over the terms.

    Raises:
        KeyError: a term has no weight. (A weight whose term was never computed is the stage's error.)
    """
    values = torch.stack(list(terms.values()))
    return (values * values.new_tensor([weights[name] for name in terms])).sum()


def mean_of(values: Iterable[Tensor]) -> Tensor:
    """The mean of scalars, such as one for each subject; 0 of none."""
    values = list(values)
    return torch.stack(values).mean() if values else torch.zeros(())
