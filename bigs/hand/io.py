"""MANO-format model files to `HandModel`, every field checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from bigs.archives import read_npz
from bigs.checks import InputError, check_choice, check_finite, check_shape, found_at
from bigs.files import open_regular
from bigs.hand.builtin import builtin_hand
from bigs.hand.model import MANO_PARENTS, HandModel
from bigs.types import SIDES, Side
from bigs.unpickle import CHUMPY, restricted_load

FILE_STEMS: dict[Side, str] = {"right": "MANO_RIGHT", "left": "MANO_LEFT"}
REQUIRED = (
    "v_template",
    "f",
    "shapedirs",
    "posedirs",
    "weights",
    "J_regressor",
    "kintree_table",
    "hands_mean",
)

# Fingertip vertices (thumb, index, middle, ring, pinky) of MANO's own mesh, whose file does not list them.
MANO_VERTICES = 778
MANO_TIPS = (744, 320, 443, 554, 671)

# Size of a hand in metres; one in millimetres lies outside.
HAND_EXTENT = (0.05, 0.6)

# Largest deviation from 1 of a row that should sum to 1.
SUM_TOLERANCE = 1e-3


def load_hand_models(path: str | Path | None) -> dict[Side, HandModel]:
    """Both hands from a folder of model files, or the built-in hand.

    Args:
        path: a folder holding MANO_RIGHT and, optionally, MANO_LEFT as .npz or .pkl; a right-hand file; or
            None for the built-in hand. Without a left file the left hand is the mirrored right hand.

    Raises:
        InputError: a file is missing or is not a valid hand model.
    """
    if path is None:
        right = builtin_hand("right")
        return {"right": right, "left": right.mirrored()}
    right = load_hand_model(path, "right")
    left_file = find_model_file(Path(path), "left") if Path(path).is_dir() else None
    return {"right": right, "left": load_hand_model(left_file, "left") if left_file else right.mirrored()}


def load_hand_model(path: str | Path, side: Side) -> HandModel:
    """One hand from a model file.

    Args:
        path: the .npz or .pkl file, or a folder that holds it (itself or in a sub-folder `mano`).
        side: which hand.

    Raises:
        InputError: there is no such file, or it is not a valid model of that hand.
    """
    check_choice("hand side", side, SIDES)
    path = Path(path)
    file = find_model_file(path, side) if path.is_dir() else path
    if file is None:
        raise InputError(
            f"{path}: expected {FILE_STEMS[side]}.npz or {FILE_STEMS[side]}.pkl in this folder, found neither"
        )
    if file.is_dir() or not file.exists():
        raise InputError(
            f"{file}: expected a hand model file (.npz or .pkl) or a folder of them, found {found_at(file)}"
        )
    return hand_model_from_arrays(read_model_file(file), side, name=str(file))


def find_model_file(folder: Path, side: Side) -> Path | None:
    """The model file of a hand in `folder` or `folder/mano`, .npz before .pkl; None when there is none."""
    for place in (folder, folder / "mano"):
        for suffix in (".npz", ".pkl"):
            file = place / (FILE_STEMS[side] + suffix)
            if file.is_file():
                return file
    return None


def read_model_file(file: Path) -> dict[str, Any]:
    """The raw arrays of an .npz file or of a .pkl file in MANO's original layout, unchecked.

    Raises:
        InputError: the file cannot be read, or is a pickle of anything but data.
    """
    if file.suffix == ".npz":
        return read_npz(file, "a hand model")
    if file.suffix != ".pkl":
        raise InputError(f"{file}: expected a hand model with suffix .npz or .pkl, found '{file.suffix}'")
    with open_regular(file, "a hand model") as stream:
        arrays = restricted_load(stream, name=str(file), allow=CHUMPY)
    if not isinstance(arrays, dict):
        raise InputError(f"{file}: expected a pickled dictionary of arrays, found {type(arrays).__name__}")
    return arrays


def hand_model_from_arrays(arrays: dict[str, Any], side: Side, *, name: str) -> HandModel:
    """A checked `HandModel` from MANO's arrays.

    Args:
        arrays: under MANO's key names; `tip_vertex_ids` [5] is needed unless there are 778 vertices.
        side: which hand they should describe.
        name: what to call their source in messages.

    Raises:
        InputError: a field is missing, has another shape, is not finite, or contradicts the others.
    """
    missing = [key for key in REQUIRED if key not in arrays]
    if missing:
        raise InputError(f"{name}: expected a hand model with field '{missing[0]}', found {_listed(arrays)}")
    joints = len(MANO_PARENTS)
    v_template = _floats(arrays, "v_template", ("V", 3), name)
    vertices = len(v_template)
    _check_extent(v_template, name)
    weights = _floats(arrays, "weights", (vertices, joints), name)
    regressor = _floats(arrays, "J_regressor", (joints, vertices), name)
    shapedirs = _floats(arrays, "shapedirs", (vertices, 3, 10), name)
    posedirs = _floats(arrays, "posedirs", (vertices, 3, 9 * (joints - 1)), name)
    hands_mean = _floats(arrays, "hands_mean", None, name)
    if hands_mean.size != 3 * (joints - 1):
        raise InputError(f"{name}, hands_mean: expected 45 values, found shape {list(hands_mean.shape)}")
    faces = _integers(arrays, "f", ("F", 3), name)
    _check_indices(f"{name}, f", faces, vertices)
    _check_rows_sum_to_one(f"{name}, weights", weights)
    _check_rows_sum_to_one(f"{name}, J_regressor", regressor)
    if weights.min() < -SUM_TOLERANCE:
        raise InputError(f"{name}, weights: expected no negative skinning weight, found {weights.min():.4g}")
    _check_tree(arrays, name)
    _check_side((regressor @ v_template), side, name)
    return HandModel(
        side,
        v_template=v_template,
        faces=faces,
        shapedirs=shapedirs,
        posedirs=posedirs,
        J_regressor=regressor,
        lbs_weights=weights,
        hands_mean=hands_mean.reshape(-1, 3),
        tip_vertex_ids=_tips(arrays, vertices, name),
    )


def _listed(arrays: dict[str, Any]) -> str:
    names = sorted(map(str, arrays))
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "") if names else "no field at all"


def _floats(arrays: dict[str, Any], key: str, shape: tuple[int | str, ...] | None, name: str) -> np.ndarray:
    value = arrays[key]
    if scipy.sparse.issparse(value):
        # Check the shape before a forged sparse matrix is made dense.
        if shape is not None:
            check_shape(f"{name}, {key}", value, shape)
        value = value.toarray()
    # Lists may be ragged or hold text; MANO stores arrays.
    if not isinstance(value, np.ndarray | np.number):
        raise InputError(f"{name}, {key}: expected an array of numbers, found {type(value).__name__}")
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name}, {key}: expected an array of numbers, found dtype {array.dtype}")
    if shape is not None:
        check_shape(f"{name}, {key}", array, shape)
    check_finite(f"{name}, {key}", array)
    return array.astype(np.float64)


def _integers(arrays: dict[str, Any], key: str, shape: tuple[int | str, ...], name: str) -> np.ndarray:
    array = _floats(arrays, key, shape, name)
    if (array != np.round(array)).any():
        raise InputError(f"{name}, {key}: expected whole numbers, found {array[array != np.round(array)][0]}")
    return array.astype(np.int64)


def _check_extent(v_template: np.ndarray, name: str) -> None:
    extent = float(np.ptp(v_template, axis=0).max()) if len(v_template) else 0.0
    if not HAND_EXTENT[0] < extent < HAND_EXTENT[1]:
        raise InputError(f"{name}, v_template: expected a hand in metres, found {extent:.4g} across")


def _check_indices(name: str, indices: np.ndarray, vertices: int) -> None:
    if indices.size and (indices.min() < 0 or indices.max() >= vertices):
        wrong = indices.max() if indices.max() >= vertices else indices.min()
        raise InputError(f"{name}: expected vertex numbers from 0 to {vertices - 1}, found {wrong}")


def _check_rows_sum_to_one(name: str, matrix: np.ndarray) -> None:
    sums = matrix.sum(axis=1)
    row = int(np.abs(sums - 1).argmax())
    if abs(sums[row] - 1) > SUM_TOLERANCE:
        raise InputError(f"{name}: expected rows that sum to 1, found {sums[row]:.4g} in row {row}")


def _check_tree(arrays: dict[str, Any], name: str) -> None:
    table = _integers(arrays, "kintree_table", (2, len(MANO_PARENTS)), name)
    # The root's own parent is stored as 2**32 - 1 or -1 and is ignored.
    found = tuple(int(parent) for parent in table[0, 1:])
    if found != MANO_PARENTS[1:]:
        raise InputError(
            f"{name}, kintree_table: expected the parents {list(MANO_PARENTS[1:])} of MANO's joints, "
            f"found {list(found)}"
        )


def _check_side(joints: np.ndarray, side: Side, name: str) -> None:
    """MANO's right hand points its fingers to -x, its left hand to +x."""
    reach = float((joints[1:] - joints[0]).mean(axis=0)[0])
    if (reach < 0) != (side == "right"):
        towards = {"right": "-x", "left": "+x"}
        other: Side = "left" if side == "right" else "right"
        raise InputError(
            f"{name}, v_template: expected a {side} hand (fingers towards {towards[side]}), "
            f"found fingers towards {towards[other]} as a {other} hand has them"
        )


def _tips(arrays: dict[str, Any], vertices: int, name: str) -> np.ndarray:
    if "tip_vertex_ids" in arrays:
        tips = _integers(arrays, "tip_vertex_ids", (5,), name)
        _check_indices(f"{name}, tip_vertex_ids", tips, vertices)
        return tips
    if vertices != MANO_VERTICES:
        raise InputError(
            f"{name}: expected {MANO_VERTICES} vertices or a field 'tip_vertex_ids' with the 5 fingertips, "
            f"found {vertices} vertices and no such field"
        )
    return np.array(MANO_TIPS)
