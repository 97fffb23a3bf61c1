"""The object's size from contact: hands that touch it in the image must touch it in space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.losses.contact import surface_gaps
from bigs.models.scene import Scene
from bigs.train.plan.config import ScaleSearchStage
from bigs.types import Side

# Until grasps are known, this many consecutive frames count as one piece of evidence, since neighbours err
# alike.
_PIECE = 8
# Number of choices of the evidence that are asked.
_CHOICES = 200


class FoundSize(NamedTuple):
    """The result of a search."""

    factor: float  # relative to the previous scale
    # Standard error of the factor, by what other choices of the grasps would have said; NaN for a single one.
    spread: float
    factors: Tensor  # [C] tried
    costs: Tensor  # [C]

    def text(self) -> str:
        """The factor, and its error where it is known."""
        return in_words(self.factor, self.spread)


def in_words(factor: float, spread: float) -> str:
    """A factor and its standard error, which may be NaN."""
    return f"{factor:.3f} ± {spread:.3f}" if spread == spread else f"{factor:.3f}"


@torch.no_grad()
def search_object_scale(
    scene: Scene,
    stage: ScaleSearchStage,
    touching: dict[Side, Tensor],
    occlusion: Callable[[], float] = lambda: 0.0,
) -> FoundSize:
    """Set the object's scale, which does not change its projection, to where the hands touch its surface
    best.

    The cost is the contact term's own plus `stage.labels_weight` times `occlusion()`: how badly the scene as
    it is agrees with what hides what in the images. Every frame counts by how sure its touch is.

    Args:
        scene: changed in place; left as it was when no frame touches.
        stage: the factors to try.
        touching: for each hand [T] in [0, 1], how sure it is that it touches.
        occlusion: see above.
    """
    factors = torch.linspace(1.0 - stage.span, 1.0 + stage.span, stage.candidates)
    start = scene.object_poses.log_scale.clone()
    frames = torch.arange(scene.n_frames)
    # Hands stay where they are, though a grasp would carry them along.
    hands = {side: scene.at(frames).posing(side) for side in scene.sides}
    gaps = {side: torch.zeros(len(factors), scene.n_frames) for side in hands}
    hidden = torch.zeros(len(factors))
    for c, factor in enumerate(factors):
        scene.object_poses.log_scale.copy_(start + factor.log())
        carrier = scene.object_poses(frames)
        for side, hand in hands.items():
            gaps[side][c] = surface_gaps(scene.object_distance.touch(hand, *carrier).depths[:, 0])
        hidden[c] = stage.labels_weight * occlusion()
    scene.object_poses.log_scale.copy_(start)
    costs = _costs(gaps, touching) + hidden
    if not any(bool(t.any()) for t in touching.values()):
        return FoundSize(1.0, float("nan"), factors, costs)
    pieces = [(side, piece) for side in hands for piece in _pieces(scene, side, touching[side])]
    best, spread = lowest(factors, costs), float("nan")
    if len(pieces) > 1:
        best, spread = agreed(_of_choices(factors, gaps, touching, pieces, hidden))
    scene.object_poses.log_scale.copy_(start + torch.tensor(best).log())
    return FoundSize(best, spread, factors, costs)


def _costs(gaps: dict[Side, Tensor], touching: dict[Side, Tensor]) -> Tensor:
    """The contact term [C] at every factor: the mean over the hands of their mean over frames."""
    means = [(gaps[side] * touching[side]).sum(1) / touching[side].sum().clamp_min(1.0) for side in gaps]
    return torch.stack(means).mean(0)


def lowest(factors: Tensor, costs: Tensor) -> float:
    """The one of evenly spaced factors [C] that has the least cost [C], between them by a parabola."""
    best = int(costs.argmin())
    if best in (0, len(costs) - 1):
        return float(factors[best])
    before, here, after = costs[best - 1 : best + 2].tolist()
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(factors[best] + shift * (factors[best + 1] - factors[best]))


def _pieces(scene: Scene, side: Side, touching: Tensor) -> list[Tensor]:
    """Frames [T] (bool) that form one piece of evidence: those of a grasp, or a few consecutive ones."""
    grasps = scene.grasps[side]
    numbers = grasps.of_frame if grasps.count else torch.arange(len(touching)) // _PIECE
    pieces = [(numbers == g) & (touching > 0) for g in numbers.unique() if g >= 0]
    return [piece for piece in pieces if piece.any()]


def _of_choices(
    factors: Tensor,
    gaps: dict[Side, Tensor],
    touching: dict[Side, Tensor],
    pieces: Sequence[tuple[Side, Tensor]],
    hidden: Tensor,
) -> Tensor:
    """The factors of least cost [R] for random choices of as many pieces, each any number of times."""
    found = []
    for times in choices(len(pieces)):
        weights = {side: torch.zeros_like(touch) for side, touch in touching.items()}
        for count, (side, piece) in zip(times.tolist(), pieces, strict=True):
            weights[side] += count * piece * touching[side]
        found.append(lowest(factors, _costs(gaps, weights) + hidden))
    return torch.tensor(found)


def choices(count: int) -> Tensor:
    """How often each of `count` pieces of evidence is asked in random choices of as many: [R, count]."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randint(count, (_CHOICES, count), generator=generator)
    return torch.nn.functional.one_hot(drawn, count).sum(1)


def agreed(found: Tensor) -> tuple[float, float]:
    """The bootstrap's estimate and its standard error.

    Under poor masks the cost has a wide floor with several minima, and which of them is the least hangs on
    one grasp; the median of all choices does not. A jackknife would fail, since it needs a minimum that
    moves evenly.
    """
    return float(found.median()), float(found.std())
