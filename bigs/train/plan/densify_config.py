"""When and where the object's Gaussians are cloned, split and pruned."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DensifyConfig:
    """When the object's Gaussians are cloned, split and pruned, and which of them.

    Numbers are the released code's; where a condition of its can never be met, 3DGS's.
    """

    # First time, last time and interval as shares of the stage's steps: 3600, 14400 and 600 of 30 000.
    first: float = 0.12
    last: float = 0.48
    every: float = 0.02
    # Threshold of the gradient at a Gaussian's centre on screen, averaged over the views that show it, in
    # 3DGS's unit: error averaged over all pixels of the clip's image, per half that image. It depends neither
    # on the stage's image size nor on the object's.
    threshold: float = 2e-4
    # A Gaussian above the threshold is cloned if its longest axis is up to this share of the object's radius,
    # and split if it is longer. The released 0.001 is 1 mm, which for a hand-held object is this.
    small: float = 0.01
    # Gaussians longer than this share, or less opaque than `least_opacity`, are pruned.
    large: float = 0.1
    least_opacity: float = 0.005
    # Nothing is pruned below `floor` Gaussians, and none is added above `ceiling`.
    floor: int = 10_000
    ceiling: int = 200_000

    def is_due(self, steps: int, step: int) -> bool:
        """Whether a stage of `steps` steps clones, splits and prunes after its first `step` ones.

        Not after the last: what is new then would never be optimised.
        """
        first, last, every = self._times(steps)
        return 0 < step < steps and first <= step <= last and (step - first) % every == 0

    def watches(self, steps: int, step: int) -> bool:
        """Whether the step after `step` others contributes to the next densification."""
        first, last, every = self._times(steps)
        until = first + every * ((min(last, steps - 1) - first) // every)
        return first - every <= step < until

    def _times(self, steps: int) -> tuple[int, int, int]:
        return round(self.first * steps), round(self.last * steps), max(1, round(self.every * steps))
