"""Adaptive density control: which of the object's Gaussians are split or removed, and when.

As in 3D Gaussian splatting, a Gaussian at whose centre on screen the loss pulls hard is one too few. Here its
colour, size and place are a field's, so what is added or removed is where that field is evaluated: no moment
of the optimiser belongs to a single Gaussian.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.geometry.rotations import quat_to_matrix
from bigs.models.canonical import CanonicalObject
from bigs.models.object_splats import Anchors
from bigs.train.plan.densify_config import DensifyConfig

# The two parts of a Gaussian are shorter by this factor, as in 3DGS.
_SHORTER = 1.6
# Distance of each part from the middle, in standard deviations: together they then have its covariance. 3DGS
# draws the places at random, but where a field moves neighbours alike that leaves holes.
_APART = math.sqrt(1.0 - _SHORTER**-2)


class Pull(NamedTuple):
    """Statistics of N Gaussians since the last densification."""

    total: Tensor  # [N] sum of gradient norms at its centre over the views that showed it
    views: Tensor  # [N] number of these views
    drift: Tensor  # [N, 3] summed gradient at its centre in the object's frame

    @classmethod
    def none(cls, count: int) -> Pull:
        """Of `count` Gaussians, before any step."""
        return cls(torch.zeros(count), torch.zeros(count), torch.zeros(count, 3))

    def plus(self, on_screen: Tensor, shown: Tensor, drift: Tensor) -> Pull:
        """With one step more; a new one, so that a kept one stays as it was.

        Args:
            on_screen: [B, N, 2] gradient in each of B views.
            shown: [B, N] bool.
            drift: [N, 3].
        """
        pull = on_screen.norm(dim=-1) * shown
        return Pull(self.total + pull.sum(0), self.views + shown.sum(0), self.drift + drift)

    @property
    def mean(self) -> Tensor:
        """[N]; 0 for what no view showed."""
        return self.total / self.views.clamp_min(1.0)


class Fates(NamedTuple):
    """What to do with N Gaussians; those in none of the sets stay."""

    cloned: Tensor  # [N] bool
    split: Tensor
    pruned: Tensor


def fates(whole: CanonicalObject, pull: Tensor, radius: float, config: DensifyConfig) -> Fates:
    """Decide over N Gaussians by their mean pull [N] on an object of some radius (metres).

    The ceiling excludes those with the least pull; the floor keeps the more opaque and the shorter. A
    Gaussian that is split is not pruned for its length.
    """
    count = len(pull)
    transparent = whole.opacities < config.least_opacity
    longest = whole.scales.amax(-1) / radius
    wanting = (pull >= config.threshold) & ~transparent
    oversized = (longest > config.large) & ~wanting
    wanting = _first(wanting, -pull, config.ceiling - count)
    # The most transparent go first, then the longest.
    rank = torch.where(transparent, whole.opacities, 1.0 + 1.0 / longest)
    pruned = _first(transparent | oversized, rank, count + int(wanting.sum()) - config.floor)
    return Fates(wanting & (longest <= config.small), wanting & (longest > config.small), pruned)


def _first(chosen: Tensor, rank: Tensor, room: int) -> Tensor:
    """The `room` of lowest rank [N] among those chosen [N]; the earlier of equals."""
    index = torch.nonzero(chosen).flatten()
    index = index[rank[index].argsort(stable=True)[: max(room, 0)]]
    return torch.zeros_like(chosen).index_fill(0, index, True)


@torch.no_grad()
def densified(
    anchors: Anchors, whole: CanonicalObject, pull: Pull, config: DensifyConfig, isotropic: bool = False
) -> Anchors:
    """Where to evaluate the field from now on.

    A clone stands one standard deviation off in the direction that lowers the loss. The two parts of a
    Gaussian that is split lie side by side along its longest axis.

    Args:
        anchors: of N Gaussians.
        whole: what the field makes of them now.
        pull: gathered of them.
        config: see that class.
        isotropic: whether parts are shorter along all axes.
    """
    fate = fates(whole, pull.mean, object_radius(anchors.base_points), config)
    rotations, scales = quat_to_matrix(whole.quats), whole.scales
    downhill = -torch.nn.functional.normalize(pull.drift[fate.cloned], dim=-1)
    own = rotations[fate.cloned].transpose(-1, -2) @ downhill[..., None]
    aside = (rotations[fate.cloned] @ (scales[fate.cloned, :, None] * own))[..., 0]
    clones = _take(anchors, fate.cloned)
    clones = clones._replace(base_points=clones.base_points + aside)

    halves = _take(anchors, fate.split)
    along = torch.nn.functional.one_hot(scales[fate.split].argmax(-1), 3).to(scales)
    aside = _APART * (rotations[fate.split] @ (scales[fate.split] * along)[..., None])[..., 0]
    shorter = math.log(_SHORTER) * (torch.ones_like(along) if isotropic else along)
    halves = halves._replace(base_log_scales=halves.base_log_scales - shorter)
    pairs = [halves._replace(base_points=halves.base_points + side * aside) for side in (-1.0, 1.0)]
    left = _take(anchors, ~(fate.split | fate.pruned))
    return Anchors(*(torch.cat(values) for values in zip(left, clones, *pairs, strict=True)))


def object_radius(points: Tensor) -> float:
    """Largest distance of points [N, 3] from the middle of their bounding box."""
    middle = 0.5 * (points.amin(0) + points.amax(0))
    return float((points - middle).norm(dim=-1).amax())


def _take(anchors: Anchors, which: Tensor) -> Anchors:
    return Anchors(*(values[which] for values in anchors))
