"""What a fit found out, did and left out, for logs and tables."""

from __future__ import annotations

from dataclasses import dataclass, field

# What is spared, in the words of the report; of the last, the share stands before it.
FROZEN = "fields that a stage does not train, in all of its steps but one"
SETTLED = "steps of stages whose loss had settled"
OUTSIDE = "of every picture, where hands and object never are"


@dataclass
class FitReport:
    """What happened, for logs and tables."""

    seconds: dict[str, float] = field(default_factory=dict)  # per stage; they add up to the whole
    skipped: list[str] = field(default_factory=list)  # what was not done, and why
    retreats: list[str] = field(default_factory=list)  # what was not finite, and how the run went on
    facts: dict[str, str] = field(default_factory=dict)  # what was found out about the clip
    # Seconds that were not spent on what the clip or a stage does not need, by what that is.
    spared: dict[str, float] = field(default_factory=dict)
    completed: bool = False  # whether symmetry has completed the object
    # Seconds of the interrupted runs that this one continues; `seconds` includes them.
    before: float = 0.0

    def add_fact(self, about: str, text: str) -> None:
        """One more thing that was found out about something."""
        self.facts[about] = f"{self.facts[about]}, {text}" if about in self.facts else text

    def spare(self, what: str, seconds: float) -> None:
        """Count seconds that were not spent on something."""
        self.spared[what] = self.spared.get(what, 0.0) + seconds

    def left_out(self, outside: float) -> str:
        """What was spared, with its seconds; `outside` is the share of pictures that nobody looked at."""
        told = []
        for what, seconds in self.spared.items():
            if what == OUTSIDE and outside > 0.0:
                told.append(f"{outside:.0%} {what} ({seconds:.2g} s)")
            elif what != OUTSIDE and seconds > 0.0:
                told.append(f"{what} ({seconds:.2g} s)")
        return ", ".join(told)
