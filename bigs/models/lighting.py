"""Light that stands still while hands and object turn in it, and shade that changes.

A Gaussian with one fixed colour cannot be lit from above in one frame and from below in the next. Here its
colour is an albedo times a smooth function of the direction its surface faces in camera space: one quadratic
function for the clip, and for each subject and frame a linear one, since a hand that closes over the object
shades itself; for each part of a subject (a hand's bones, an object's regions) a constant as well, since a
finger shades its neighbour and a hand the side that it holds. (The paper has fixed colours; a run may switch
this off.)
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import nn

from bigs.types import Entity

# A hand has 16 bones, and an object gets as many regions.
N_PARTS = 16


class Lighting(nn.Module):
    """exp of a polynomial of the normal; 1 everywhere at the start.

    Irradiance under distant light is very nearly quadratic in the normal; the exponential keeps it positive.
    The clip's function has no constant, since the albedo holds it.
    """

    def __init__(self, entities: Iterable[Entity], n_frames: int) -> None:
        super().__init__()
        self.clip = nn.Parameter(torch.zeros(8, 3))
        # Constant, slopes along x, y, z, and parts. Brightness only: shade has no colour.
        self.shade = nn.ParameterDict(
            {entity: nn.Parameter(torch.zeros(n_frames, 4 + N_PARTS)) for entity in entities}
        )
