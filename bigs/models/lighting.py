"""Light that stands still while hands and object turn in it, and shade that changes.

A Gaussian with one fixed colour cannot be lit from above in one frame and from below in the next. Here its
colour is an albedo times a smooth function of the direction its surface faces in camera space: one quadratic
function for the clip, and for each subject and frame a linear one, since a hand that closes over the object
shades itself; for each part of a subject (a hand's bones, an object's regions) a constant as well, since a
finger shades its neighbour and a hand the side that it holds; and ambient occlusion, since a surface is
darker the less of the sky it sees past the others. (The paper has fixed colours; a run may switch this off.)
"""

from __future__ import annotations

from collections.abc import Iterable, MutableMapping

import numpy as np
import scipy.spatial
import torch
from torch import Tensor, nn

from bigs.types import Entity

# A hand has 16 bones, and an object gets as many regions.
N_PARTS = 16

# Logarithm of a colour's factor under a sky that is covered altogether, at the start. Pictures hold roots of
# the light, and what covers the sky gives some of it back; what is learned lies around this value.
_COVERED = -0.7
# A recording keeps shares as bytes, and a scene looks as its recording does.
LEVELS = 255
# Occlusion between samples is a mean of so many of them, and none counts as nearer than this, metres.
_BETWEEN, _NEAREST = 3, 1e-4


class Occlusion(nn.Module):
    """Ambient occlusion: how much of the sky above a subject is covered, at samples of it in every frame."""

    places: Tensor
    shares: Tensor

    def __init__(self, n_frames: int) -> None:
        super().__init__()
        self.register_buffer("places", torch.zeros(1, 3))
        self.register_buffer("shares", torch.zeros(n_frames, 1))
        self._known: tuple[tuple[int, ...], Tensor, Tensor] | None = None

    def place(self, places: Tensor, shares: Tensor) -> None:
        """Samples [S, 3] in the subject's own rest space, metres, and their shares [T, S] in [0, 1]."""
        self.places, self.shares, self._known = places, shares, None

    def at(self, points: Tensor) -> Tensor:
        """Shares [T, N] in steps of 1 / `LEVELS` at points [N, 3] of the rest space; kept for later."""
        versions = tuple(tensor._version for tensor in (points, self.places, self.shares))
        if self._known is None or self._known[0] != versions or self._known[1] is not points:
            self._known = versions, points, self._between(points)
        return self._known[2]

    @torch.no_grad()
    def _between(self, points: Tensor) -> Tensor:
        samples = self.places.numpy().astype(np.float64)
        count = min(_BETWEEN, len(samples))
        distance, index = scipy.spatial.cKDTree(samples).query(points.numpy(), k=range(1, count + 1))
        weight = 1.0 / (distance + _NEAREST) ** 2
        weight /= weight.sum(-1, keepdims=True)
        found = self.shares.new_zeros(len(self.shares), len(points))
        for column in range(count):
            near = torch.from_numpy(index[:, column])
            found += self.shares[:, near] * torch.from_numpy(weight[:, column]).to(self.shares)
        return (LEVELS * found).round() / LEVELS


class Lighting(nn.Module):
    """exp of a polynomial of the normal and of a multiple of the occlusion; 1 everywhere at the start.

    Irradiance under distant light is very nearly quadratic in the normal; the exponential keeps it positive.
    The clip's function has no constant, since the albedo holds it.
    """

    # A module's own container, typed by what it holds.
    occlusion: MutableMapping[Entity, Occlusion]

    def __init__(self, entities: Iterable[Entity], n_frames: int) -> None:
        super().__init__()
        entities = tuple(entities)
        self.clip = nn.Parameter(torch.zeros(8, 3))
        # Constant, slopes along x, y, z, and parts. Brightness only: shade has no colour.
        self.shade = nn.ParameterDict(
            {entity: nn.Parameter(torch.zeros(n_frames, 4 + N_PARTS)) for entity in entities}
        )
        # Skin gives back more red than blue, so what covers the sky does have a colour.
        self.ambient = nn.ParameterDict(
            {entity: nn.Parameter(torch.full((3,), _COVERED)) for entity in entities}
        )
        # Nothing is covered until it is measured (see `bigs.models.occlusion`).
        self.occlusion = nn.ModuleDict(  # type: ignore[assignment]
            {entity: Occlusion(n_frames) for entity in entities}
        )

    @property
    def measured(self) -> bool:
        """Whether what covers the subjects is known."""
        return any(len(known.places) > 1 for known in self.occlusion.values())
