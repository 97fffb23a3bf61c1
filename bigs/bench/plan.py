"""The options of `bigs bench engine`."""

from __future__ import annotations

from dataclasses import dataclass

from bigs.bench.peers import PEERS
from bigs.bench.workloads import KINDS, WorkloadSpec
from bigs.checks import InputError, check_choice

PARTS = ("levels", "stages", "memory", "skips", "curve", "peers")


@dataclass(frozen=True)
class Plan:
    """What to measure."""

    workloads: tuple[WorkloadSpec, ...]
    threads: tuple[int, ...] = (1, 2)
    parts: tuple[str, ...] = PARTS
    peers: tuple[str, ...] = tuple(PEERS)
    repeats: int = 15
    budget: float = 20.0  # seconds after which a variant of a workload is not called again


def check_plan(plan: Plan) -> None:
    """Refuse what cannot be measured, before anything is.

    Raises:
        InputError: names the option.
    """
    for name, values, known in (
        ("--workloads", [spec.name for spec in plan.workloads], KINDS),
        ("--parts", plan.parts, PARTS),
        ("--peers", plan.peers, PEERS),
    ):
        for value in values:
            check_choice(name, value, known)
    if not plan.workloads:
        raise InputError("--workloads: expected at least one, found none")
    if not plan.threads or min(plan.threads) < 1:
        raise InputError(f"--threads: expected counts of at least 1, found {list(plan.threads)}")
    if plan.repeats < 1:
        raise InputError(f"--repeats: expected at least 1, found {plan.repeats}")
    if not plan.budget > 0:
        raise InputError(f"--budget: expected a positive number of seconds, found {plan.budget}")
    if any(not spec.scale > 0 for spec in plan.workloads):
        raise InputError(f"--scale: expected a positive number, found {plan.workloads[0].scale}")
