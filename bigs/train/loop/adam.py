"""Adam for parameters of which some have a row per frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from bigs.threads import torch_alone

# The moments of one parameter: "step" (a scalar), "exp_avg" and "exp_avg_sq".
Moments = Mapping[str, Tensor]


class FrameAdam:
    """Adam in whose groups marked `per_frame` a frame that is not in the step keeps its values and moments.

    Plain Adam moves it on by its momentum, and by what the terms over the whole clip say of it alone.

    It computes what `torch.optim.Adam(fused=True)` does. That one imports torch's compiler when it is made,
    which takes more than a second of every run.
    """

    def __init__(
        self, groups: Iterable[dict[str, Any]], betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        """
        Args:
            groups: each with "params" (parameters) and "lr"; "per_frame" may be set.
            betas: the moments' decays, for all groups.
            eps: added to the second moment's root.
        """
        self.param_groups = [{"per_frame": False, **group, "betas": betas, "eps": eps} for group in groups]
        self.state: dict[nn.Parameter, dict[str, Tensor]] = {}

    def parameters(self) -> list[nn.Parameter]:
        """All parameters in the order of their groups."""
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def zero_grad(self) -> None:
        """Let go of all gradients."""
        for parameter in self.parameters():
            parameter.grad = None

    @torch.no_grad()
    @torch_alone()
    def step(self) -> None:
        """One step along the gradients that there are."""
        for group in self.param_groups:
            moved = [parameter for parameter in group["params"] if parameter.grad is not None]
            if not moved:
                continue
            states = [self._state_of(parameter) for parameter in moved]
            counts = [state["step"] for state in states]
            torch._foreach_add_(counts, 1)
            torch._fused_adam_(
                moved,
                [parameter.grad for parameter in moved],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                counts,
                lr=group["lr"],
                beta1=group["betas"][0],
                beta2=group["betas"][1],
                weight_decay=0.0,
                eps=group["eps"],
                amsgrad=False,
                maximize=False,
            )

    @torch.no_grad()
    def step_frames(self, frames: Tensor) -> None:
        """One step that looked at `frames` [B] of the clip."""
        kept = []
        for group in self.param_groups:
            for parameter in group["params"] if group["per_frame"] else ():
                if parameter.grad is None:
                    continue
                others = torch.ones(len(parameter), dtype=torch.bool)
                others[frames] = False
                state = self._state_of(parameter)
                moments = {name: state[name][others] for name in ("exp_avg", "exp_avg_sq")}
                kept.append((parameter, others, parameter[others], moments))
        self.step()
        for parameter, others, values, moments in kept:
            parameter[others] = values
            for name, rows in moments.items():
                self.state[parameter][name][others] = rows

    def moments(self) -> dict[int, Moments]:
        """The moments of the parameters that have moved, by their place among all; not copies."""
        return {
            place: self.state[parameter]
            for place, parameter in enumerate(self.parameters())
            if parameter in self.state
        }

    def set_moments(self, moments: Mapping[int, Moments]) -> None:
        """Go on from copies of what `moments` returned."""
        parameters = self.parameters()
        self.state = {
            parameters[place]: {name: value.clone() for name, value in of_one.items()}
            for place, of_one in moments.items()
        }

    def _state_of(self, parameter: nn.Parameter) -> dict[str, Tensor]:
        if parameter not in self.state:
            self.state[parameter] = {
                "step": torch.zeros(()),
                "exp_avg": torch.zeros_like(parameter, requires_grad=False),
                "exp_avg_sq": torch.zeros_like(parameter, requires_grad=False),
            }
        return self.state[parameter]
