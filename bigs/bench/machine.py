"""Facts about the machine and about this process's memory."""

from __future__ import annotations

import os
import platform
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bigs import _raster

_STATUS = Path("/proc/self/status")


def machine_facts() -> dict[str, Any]:
    """Facts about the machine for a table of times."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_model() or platform.processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "level": _raster.simd_level(),
        "load": os.getloadavg()[0],
    }


def lower_levels() -> tuple[str, ...]:
    """CPU feature levels of the engine below the one of this machine."""
    order = {"avx512": ("avx2", "baseline"), "avx2": ("baseline",), "neon": ("baseline",)}
    return order.get(_raster.simd_level(), ())


def free_memory() -> int | None:
    """Bytes that can be had without swapping; None where the system does not say."""
    try:
        return 1024 * _kilobytes(Path("/proc/meminfo"), "MemAvailable")
    except OSError:
        return None


def peak_of(work: Callable[[], object]) -> float:
    """Bytes that `work` takes at its peak above what this process holds now.

    Memory that earlier work left to the allocator does not show, so the process should be a new one.
    """
    try:
        # Linux: writing 5 resets the recorded peak to current use.
        Path("/proc/self/clear_refs").write_text("5")
        before = _kilobytes(_STATUS, "VmRSS")
        work()
        return 1024.0 * (_kilobytes(_STATUS, "VmHWM") - before)
    except OSError:
        largest = largest_so_far()
        work()
        return largest_so_far() - largest


def largest_so_far() -> float:
    """Bytes that this process held at its largest."""
    try:
        # Linux's `ru_maxrss` survives exec, so it includes what the parent process held.
        return 1024.0 * _kilobytes(_STATUS, "VmHWM")
    except (OSError, StopIteration):
        pass
    unit = 1 if platform.system() == "Darwin" else 1024
    return float(unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def _kilobytes(file: Path, field: str) -> int:
    line = next(line for line in file.read_text().splitlines() if line.startswith(field + ":"))
    return int(line.split()[1])


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
