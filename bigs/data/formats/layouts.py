"""Recognises the layout of a path and loads its clip."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from bigs.checks import InputError, found_at
from bigs.data.base import Clip
from bigs.data.formats.arctic import find_arctic, load_arctic
from bigs.data.formats.ho3d import find_ho3d, load_ho3d
from bigs.data.formats.hold import load_hold
from bigs.data.formats.sfm_folder import is_sfm_folder, load_sfm_folder

Layout = Literal["hold", "arctic", "ho3d", "sfm"]
LAYOUT_NAMES: dict[Layout, str] = {
    "hold": "HOLD / HANDS-challenge build folder",
    "arctic": "ARCTIC raw sequence",
    "ho3d": "HO-3D clip",
    "sfm": "COLMAP or nerfstudio folder with hands.npz",
}


def layout_of(path: str | Path) -> Layout:
    """The layout of a clip.

    Raises:
        InputError: it has none of them.
    """
    path = Path(path)
    if (path / "build").is_dir() or any((path / part).exists() for part in ("data.npy", "corres.txt")):
        return "hold"
    if is_sfm_folder(path):
        return "sfm"
    if path.is_dir() and find_ho3d(path) is not None:
        return "ho3d"
    if find_arctic(path) is not None:
        return "arctic"
    found = "another folder" if path.is_dir() else found_at(path)
    raise InputError(f"{path}: expected a clip folder ({', '.join(LAYOUT_NAMES.values())}), found {found}")


def load_clip(path: str | Path, hands_mean: np.ndarray) -> Clip:
    """Read and check a clip of any layout.

    Args:
        path: the clip; for ARCTIC and HO-3D see `find_arctic` and `find_ho3d`.
        hands_mean: [15, 3] mean finger pose of the right hand's model: HO-3D's poses become relative to it.

    Raises:
        InputError: one sentence naming file, field, expected and found.
    """
    layout = layout_of(path)
    if layout == "arctic":
        return load_arctic(path)
    if layout == "ho3d":
        return load_ho3d(path, hands_mean)
    if layout == "sfm":
        return load_sfm_folder(path)
    return load_hold(path)
