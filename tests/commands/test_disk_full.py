"""A full disk and a limit on files: one sentence that names the file, and nothing that was there is lost."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from command_line import Answer, Run, assert_refused, contents

from bigs.commands.export.formats import FORMATS, write_format, write_outputs
from bigs.commands.folder.contents import load_run
from bigs.commands.folder.log import RunLog, read_log

resource = pytest.importorskip("resource")


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The system refuses to let any file grow beyond `size` bytes, as it does when a disk is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_log_that_cannot_grow_names_itself(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    event = {"event": "note", "text": "x" * 50}
    with (
        largest_file(1000),
        pytest.raises(OSError, match="too large") as caught,
        RunLog(path, resume=False) as log,
    ):
        for _ in range(100):
            log.add(event)
    assert caught.value.filename == str(path)
    assert read_log(path) == [event] * 12  # the line that did not fit is cut short


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in FORMATS if name != "hand-meshes"])
def test_every_format_is_whole_or_as_before(finished_run: Run, tmp_path: Path, name: str) -> None:
    playback = load_run(finished_run.folder)
    write_format(tmp_path, playback, name)
    before = contents(tmp_path)
    with largest_file(2000), pytest.raises(OSError, match="too large") as caught:
        write_format(tmp_path, playback, name)
    assert caught.value.errno == errno.EFBIG
    assert str(caught.value.filename) in {str(tmp_path / name) for name in before}
    assert contents(tmp_path) == before


@pytest.mark.slow
def test_the_scene_is_whole_or_as_before(finished_run: Run, tmp_path: Path) -> None:
    playback = load_run(finished_run.folder)
    write_outputs(tmp_path, playback)
    before = contents(tmp_path)
    with largest_file(2000), pytest.raises(OSError, match="too large"):
        write_outputs(tmp_path, playback)
    assert contents(tmp_path) == before


@pytest.mark.slow
@pytest.mark.parametrize(("size", "file"), [(100_000, "latest.safetensors"), (600_000, "scene.safetensors")])
def test_a_run_goes_on_when_there_is_room_again(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path, size: int, file: str
) -> None:
    """Full at a checkpoint, or at the results: the run ends with one line, and goes on from there."""
    out = tmp_path / "run"
    out.mkdir()
    for name in ("config.yaml", "log.jsonl", "checkpoints/latest.safetensors"):
        (out / name).parent.mkdir(exist_ok=True)
        shutil.copy(finished_run.folder / name, out / name)
    if file == "latest.safetensors":
        (out / "checkpoints" / file).unlink()
    before = contents(out)
    with largest_file(size):
        answer = call(*finished_run.command, "--out", out, "--resume")
    assert answer.code == 4
    assert_refused(
        Answer(answer.code, "", answer.err.splitlines()[-1] + "\n"), f"{file}: ", "found: File too"
    )
    if "checkpoints/latest.safetensors" in before:
        name = "checkpoints/latest.safetensors"
        assert contents(out)[name] == before[name]
    if file != "latest.safetensors":  # else it would be a whole run
        assert call(*finished_run.command, "--out", out, "--resume").code == 0
        for name in ("scene.safetensors", "poses.npz", "metrics.json", "preview.png"):
            assert (out / name).read_bytes() == (finished_run.folder / name).read_bytes()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path
) -> None:
    tmp_path.chmod(0o555)
    try:
        answer = call("reconstruct", tiny_clip, "--out", tmp_path / "run", "--preset", "smoke")
    finally:
        tmp_path.chmod(0o755)
    assert answer.code == 4
    assert_refused(answer, "run: ", "expected", "found: Permission denied")
