"""Model files: both layouts, and every way in which one can be wrong."""

import io
import os
import pickle
import struct
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch

from bigs.checks import InputError
from bigs.hand import HandModel, load_hand_model, load_hand_models
from bigs.hand.io import hand_model_from_arrays

Fields = dict[str, Any]


class _Python2Pickler(pickle._Pickler):  # the pure-Python pickler: its methods can be replaced one by one
    """Writes protocol 2 as Python 2 did: byte strings for text, arrays' data and names alike."""

    dispatch = pickle._Pickler.dispatch.copy()

    def save_string(self, text: str | bytes) -> None:
        data = text if isinstance(text, bytes) else text.encode("latin1")
        self.write(pickle.BINSTRING + struct.pack("<i", len(data)) + data)
        self.memoize(text)

    dispatch[bytes] = save_string
    dispatch[str] = save_string


def python2_dumps(value: Any) -> bytes:
    stream = io.BytesIO()
    _Python2Pickler(stream, protocol=2).dump(value)
    raw = stream.getvalue()
    return raw.replace(b"numpy._core.", b"numpy.core.").replace(b"scipy.sparse._csc", b"scipy.sparse.csc")


@pytest.fixture
def chumpy(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """Classes that pickle as chumpy's do; unpickling must not need them."""
    classes = {}
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    for module, name in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):
        fake = types.ModuleType(module)
        classes[name] = type(name, (), {"__module__": module})
        setattr(fake, name, classes[name])
        monkeypatch.setitem(sys.modules, module, fake)
    return types.SimpleNamespace(**classes)


def chumpy_object(cls: type, **state: Any) -> Any:
    value = cls()
    value.__dict__.update(state, _dirty_vars=set(), _itr=None, dterms=("a",))
    return value


def mano_pickle(fields: Fields, chumpy: types.SimpleNamespace) -> bytes:
    """The layout of the original files: chumpy shape directions, a sparse regressor, extra fields."""
    shapedirs = fields["shapedirs"]
    stored = np.concatenate([shapedirs.ravel()[::-1], np.zeros(7)])
    source = chumpy_object(chumpy.Ch, x=stored)
    idxs = np.arange(shapedirs.size)[::-1].copy()
    original = fields | {
        "shapedirs": chumpy_object(chumpy.Select, a=source, idxs=idxs, preferred_shape=shapedirs.shape),
        "posedirs": np.asfortranarray(fields["posedirs"]),
        "v_template": chumpy_object(chumpy.Ch, x=fields["v_template"]),
        "J_regressor": scipy.sparse.csc_matrix(fields["J_regressor"]),
        "hands_components": np.eye(45),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }
    return python2_dumps(original)


def test_original_pickle_and_npz_give_the_same_hand(
    tmp_path: Path, fields: Fields, chumpy: types.SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mano").mkdir()
    (tmp_path / "mano" / "MANO_RIGHT.pkl").write_bytes(mano_pickle(fields, chumpy))
    np.savez(tmp_path / "hand.npz", **fields)
    for module in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        monkeypatch.delitem(sys.modules, module)
    one, other = load_hand_model(tmp_path, "right"), load_hand_model(tmp_path / "hand.npz", "right")
    for (name, first), (_, second) in zip(one.named_buffers(), other.named_buffers(), strict=True):
        torch.testing.assert_close(first, second, msg=name)
    np.testing.assert_allclose(one.shapedirs.numpy(), fields["shapedirs"], rtol=1e-6)
    assert one.has_posedirs


def test_a_missing_left_file_is_the_mirrored_right(tmp_path: Path, fields: Fields) -> None:
    np.savez(tmp_path / "MANO_RIGHT.npz", **fields)
    hands = load_hand_models(tmp_path)
    assert torch.equal(hands["left"].v_template, hands["right"].mirrored().v_template)
    other = hand_model_from_arrays(fields, "right", name="x").mirrored()
    np.savez(tmp_path / "MANO_LEFT.npz", **(fields | {"v_template": 1.01 * other.v_template.numpy()}))
    assert not torch.equal(load_hand_models(tmp_path)["left"].v_template, hands["left"].v_template)


def test_mano_itself_needs_no_list_of_fingertips(fields: Fields) -> None:
    rng = np.random.default_rng(0)
    keep = np.sort(rng.choice(len(fields["v_template"]), 778, replace=False))
    cut = {key: fields[key] for key in ("kintree_table", "hands_mean")}
    cut |= {key: fields[key][keep] for key in ("v_template", "shapedirs", "posedirs", "weights")}
    regressor = fields["J_regressor"][:, keep]
    cut["J_regressor"] = regressor / regressor.sum(1, keepdims=True)
    cut["f"] = rng.integers(0, 778, (1538, 3))
    assert hand_model_from_arrays(cut, "right", name="x").tip_vertex_ids.tolist() == [744, 320, 443, 554, 671]


def changed(key: str, change: Callable[[Any], Any]) -> Callable[[Fields], Fields]:
    return lambda fields: fields | {key: change(fields[key])}


def with_value(key: str, index: tuple[int, ...], value: float) -> Callable[[Fields], Fields]:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.astype(np.float64)
        array[index] = value
        return array

    return changed(key, change)


def without(key: str) -> Callable[[Fields], Fields]:
    return lambda fields: {k: v for k, v in fields.items() if k != key}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without("weights"), ["'weights'", "v_template"]),
        (without("tip_vertex_ids"), ["tip_vertex_ids", "778"]),
        (changed("v_template", lambda v: v[:, :2]), ["v_template", "[V, 3]"]),
        (changed("v_template", lambda v: 1000 * v), ["v_template", "metres"]),
        (changed("v_template", lambda v: v[:0]), ["v_template", "metres"]),
        (changed("v_template", lambda v: v * [-1, 1, 1]), ["right hand", "left hand"]),
        (with_value("v_template", (5, 1), np.nan), ["v_template", "nan", "[5, 1]"]),
        (changed("shapedirs", lambda s: s[..., :6]), ["shapedirs", "10]", "6]"]),
        (changed("posedirs", lambda p: p[:, :, :9]), ["posedirs", "135]", "9]"]),
        (with_value("posedirs", (0, 0, 0), np.inf), ["posedirs", "inf"]),
        (changed("weights", lambda w: w[:-1]), ["weights", "16]"]),
        (changed("weights", lambda w: w * 1.1), ["weights", "sum to 1", "1.1"]),
        (
            changed("weights", lambda w: w + 0.5 * np.eye(16)[3] - 0.5 * np.eye(16)[8]),
            ["negative"],
        ),
        (changed("J_regressor", lambda j: 0.5 * j), ["J_regressor", "sum to 1", "0.5"]),
        (
            changed("J_regressor", lambda j: scipy.sparse.csc_matrix((16, 10**9))),
            ["J_regressor", "1000000000"],
        ),
        (changed("f", lambda f: f.astype(np.int64) + 100), ["f", "vertex numbers"]),
        (changed("f", lambda f: f - 0.5), ["f", "whole numbers"]),
        (changed("f", lambda f: f.astype(str)), ["f", "numbers", "dtype"]),
        (changed("kintree_table", lambda k: k[:, ::-1]), ["kintree_table", "parents"]),
        (changed("hands_mean", lambda h: h[:6]), ["hands_mean", "45", "6"]),
        (with_value("tip_vertex_ids", (2,), 10**6), ["tip_vertex_ids", "1000000"]),
        (lambda fields: {"a": 1}, ["'v_template'", "found a"]),
        (lambda fields: {}, ["'v_template'", "no field"]),
    ],
)
def test_bad_fields_are_named(fields: Fields, change: Callable[[Fields], Fields], words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        hand_model_from_arrays(change(fields), "right", name="some/file.npz")
    message = str(caught.value)
    assert message.startswith("some/file.npz")
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_a_left_hand_under_the_right_hands_name_is_noticed(tmp_path: Path, fields: Fields) -> None:
    np.savez(tmp_path / "MANO_LEFT.npz", **fields)
    with pytest.raises(InputError, match=r"expected a left hand .* found fingers towards -x"):
        load_hand_model(tmp_path, "left")


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("nowhere", "found nothing"),
        ("nowhere.npz", "found nothing"),
        ("empty", "MANO_RIGHT.pkl in this folder, found neither"),
        ("text.npz", "archive of plain arrays"),
        ("text.pkl", "readable pickle"),
        ("text.txt", "suffix .npz or .pkl, found '.txt'"),
        ("list.pkl", "dictionary of arrays, found list"),
        ("array.npz", "archive of plain arrays"),
        ("objects.npz", "archive of plain arrays"),
    ],
)
def test_what_is_no_model_file_is_refused(tmp_path: Path, path: str, words: str) -> None:
    (tmp_path / "empty").mkdir()
    for suffix in ("npz", "pkl", "txt"):
        (tmp_path / f"text.{suffix}").write_text("not a model")
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2]))
    with (tmp_path / "array.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    np.savez(tmp_path / "objects.npz", v_template=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError) as caught:
        load_hand_model(tmp_path / path, "right")
    assert words in str(caught.value)
    assert str(tmp_path / path) in str(caught.value)


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9, 0.999])
def test_truncated_files_are_refused(
    tmp_path: Path, fields: Fields, chumpy: types.SimpleNamespace, suffix: str, kept: float
) -> None:
    file = tmp_path / f"MANO_RIGHT{suffix}"
    if suffix == ".npz":
        np.savez(file, **fields)
    else:
        file.write_bytes(mano_pickle(fields, chumpy))
    whole = file.read_bytes()
    file.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(InputError, match="MANO_RIGHT"):
        load_hand_model(tmp_path, "right")


class _Touch:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.path}",)


def test_a_model_file_that_tries_to_run_code_does_not(tmp_path: Path, fields: Fields) -> None:
    evil = fields | {"shapedirs": _Touch(tmp_path / "ran")}
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(evil))
    with pytest.raises(InputError, match=r"MANO_RIGHT\.pkl.*system.*refused"):
        load_hand_model(tmp_path, "right")
    assert not (tmp_path / "ran").exists()


def test_unknown_side_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected one of right, left, found 'both'"):
        load_hand_model(tmp_path, "both")  # type: ignore[arg-type]


def test_loads_the_files_that_the_environment_names(hand_model_dir: Path) -> None:
    hands = load_hand_models(hand_model_dir)
    assert isinstance(hands["right"], HandModel)
    mirrored = hands["right"].mirrored()
    torch.testing.assert_close(hands["left"].v_template, mirrored.v_template)
