"""What a run's folder says of the run, whoever wrote into it since."""

from __future__ import annotations

from pathlib import Path

import pytest

from bigs.checks import InputError
from bigs.commands.folder.clip import Origin, clip_of_run, origin_of
from bigs.commands.folder.contents import read_scores


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "metrics.json: expected a dictionary, found list"),
        ('{"result": 3}', "metrics.json: result: expected a dictionary"),
        ('{"result": {"psnr": "good"}}', "metrics.json: result.psnr: expected an array of numbers"),
        ('{"initial": {"psnr": [1, 2]}}', "metrics.json: initial.psnr: expected shape"),
        ('{"initial": {"psnr": null}}', "metrics.json: initial.psnr: expected"),
    ],
)
def test_scores_are_numbers(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(InputError, match=words):
        read_scores(tmp_path)


def test_a_run_without_scores_has_none(tmp_path: Path) -> None:
    assert read_scores(tmp_path) == {}
    (tmp_path / "metrics.json").write_text('{"result": {"psnr": 20, "ssim": NaN}}')
    scores = read_scores(tmp_path)
    assert scores["result"]["psnr"] == 20.0 and scores["result"]["ssim"] != scores["result"]["ssim"]


@pytest.mark.parametrize(
    "value",
    [
        "[1]",
        "{a: 1}",
        "3",
        "null",
        '"nul\\0byte"',
        '"' + "x" * 5000 + '"',
        '"' + "x" * 300 + '"',
        '"\\ud800"',
    ],
)
def test_an_origin_that_is_no_path_is_none(tmp_path: Path, value: str) -> None:
    (tmp_path / "config.yaml").write_text(f"clip: {value}\nhand_model: {value}\n")
    assert origin_of(tmp_path) == Origin(None, None, None)
    assert clip_of_run(tmp_path, 3) is None


def test_an_origin_is_two_paths(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("bigs: 0.1.0\nclip: some/clip\nhand_model: null\n")
    assert origin_of(tmp_path) == Origin(Path("some/clip"), None, "0.1.0")
