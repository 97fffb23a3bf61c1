"""Names that configurations had before, and what they are called now."""

from __future__ import annotations

from bigs.checks import InputError

# Old name -> name.
RENAMED = {
    "spill": "alpha_outside",
    "least_sightings": "least_observations",
    "hold": "frame_weight",
    "held": "grasped",
}


def check_renamed(where: str, name: str) -> None:
    """Refuse an old name.

    Raises:
        InputError: names the new one.
    """
    if name in RENAMED:
        raise InputError(f"{where}: expected {RENAMED[name]}, as it is called now, found {name}")
