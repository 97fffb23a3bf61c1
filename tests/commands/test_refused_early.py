"""What cannot end well is refused before work begins, and the sentence says what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from command_line import Answer, assert_refused
from PIL import Image


def test_a_second_demo_says_what_to_do(call: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "clip").mkdir()
    (tmp_path / "config.yaml").touch()
    answer = call("demo", "--out", tmp_path)
    assert_refused(
        answer, f"{tmp_path}: expected a new or empty folder", "an earlier demo", "remove it", "--out"
    )


def test_a_demo_spares_other_files(call: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("mine")
    assert_refused(call("demo", "--out", tmp_path), "expected a new or empty folder", "found other files")
    assert_refused(call("demo", "--out", tmp_path / "letter.txt"), "found a file")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_no_frames_are_extracted_without_masks(call: Callable[..., Answer], tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    Image.new("RGB", (32, 24)).save(images / "0.png")
    answer = call("preprocess", images, "--out", tmp_path / "clip")
    assert_refused(answer, "expected masks of hands and object", "--masks DIR", "bigs preprocess frames")
    answer = call("preprocess", images, "--out", tmp_path / "clip", "--masks", tmp_path / "image")
    assert_refused(answer, f"image: expected a folder of masks, found nothing; did you mean {images}?")
    assert not (tmp_path / "clip").exists()


def test_the_run_inside_a_folder_is_named(call: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "outer" / "run").mkdir(parents=True)
    (tmp_path / "outer" / "run" / "scene.safetensors").touch()
    answer = call("eval", tmp_path / "outer")
    assert_refused(answer, "expected a run folder", f"did you mean {tmp_path / 'outer' / 'run'}?")
