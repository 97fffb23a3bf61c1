"""The checks at the border say what, where, expected and found, in one sentence."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bigs.checks import InputError, check_choice, check_finite, check_shape, found_at


def message(check, *arguments) -> str:
    with pytest.raises(InputError) as raised:
        check(*arguments)
    return str(raised.value)


@pytest.mark.parametrize("make", [np.zeros, torch.zeros])
def test_shapes_that_match_pass(make) -> None:
    check_shape("x", make((4, 3)), (4, 3))
    check_shape("x", make((4, 3)), ("N", None))
    check_shape("x", make(()), ())


@pytest.mark.parametrize("make", [np.zeros, torch.zeros])
@pytest.mark.parametrize("shape", [(2, 3), (4,), (1, 4, 4), ()])
def test_a_wrong_shape_is_named(make, shape) -> None:
    text = message(check_shape, "poses.npz: hand_pose", make(shape), (None, 4))
    assert text == f"poses.npz: hand_pose: expected shape [any, 4], found {list(shape)}"


def test_axis_names_are_shown() -> None:
    assert message(check_shape, "x", np.zeros(3), ("T", 15, 3)).startswith("x: expected shape [T, 15, 3],")


def test_finite_values_pass() -> None:
    check_finite("x", np.arange(6).reshape(2, 3))
    check_finite("x", torch.zeros(2, requires_grad=True))
    check_finite("x", np.zeros((0, 3)))


@pytest.mark.parametrize("make", [np.array, torch.tensor])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_the_first_value_that_is_not_finite_is_named(make, bad) -> None:
    text = message(check_finite, "clip: K", make([[1.0, 2.0], [3.0, bad], [bad, 0.0]]))
    assert text == f"clip: K: expected finite values, found {bad} at index [1, 1]"


def test_choices() -> None:
    check_choice("side", "left", ("right", "left"))
    check_choice("side", 2, iter([1, 2]))
    assert message(check_choice, "side", "up", iter(["right", "left"])) == (
        "side: expected one of right, left, found 'up'"
    )


def test_an_input_error_is_a_value_error() -> None:
    assert issubclass(InputError, ValueError)


@pytest.mark.parametrize(
    ("value", "choices", "words"),
    [
        ("fst", ["fast", "full"], "expected one of fast, full, found 'fst'; did you mean fast?"),
        ("zzz", ["fast", "full"], "expected one of fast, full, found 'zzz'"),
        (
            "contct",
            ["contact", *"abcdefghijkl"],
            "expected one of 13 terms, found 'contct'; did you mean contact?",
        ),
        ("zzz", list("abcdefghijklm"), "expected one of a, b, c, d, e, f, g, h, i, j, k, l, m, found 'zzz'"),
        ("PLY", ["ply"], "expected one of ply, found 'PLY'; did you mean ply?"),
        (3, [1, 2], "expected one of 1, 2, found 3"),
    ],
)
def test_the_nearest_choice_is_named(value: object, choices: list[object], words: str) -> None:
    with pytest.raises(InputError) as refused:
        check_choice("x", value, choices, kind="terms")
    assert str(refused.value) == f"x: {words}"


def test_the_nearest_neighbour_of_a_missing_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").touch()
    assert found_at(tmp_path / "camera.json") == f"nothing; did you mean {tmp_path / 'cameras.json'}?"
    assert found_at(tmp_path / "zzz") == found_at(tmp_path / "none" / "camera.json") == "nothing"
    assert found_at(tmp_path) == "a folder"
    assert found_at(tmp_path / "cameras.json") == "a file"


@pytest.mark.parametrize(
    "value", [np.ones(3), np.array(["a", "b"]), np.array("a"), torch.ones(2), ["a"], {}, None]
)
def test_what_is_no_choice_at_all(value: object) -> None:
    with pytest.raises(InputError, match="order: expected one of a, b, found"):
        check_choice("order", value, ("a", "b"))
