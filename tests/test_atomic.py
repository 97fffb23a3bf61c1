"""A file is the old one or the new one, whatever happens in between."""

import errno
import os
import stat
from pathlib import Path

import pytest

from bigs.atomic import atomic_write, remove_parts


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_new_content_takes_the_place_of_the_old(tmp_path: Path) -> None:
    path = tmp_path / "scene.bin"
    path.write_bytes(b"a long old content")
    with atomic_write(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"a long old content"  # nothing shows before the end
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["scene.bin"]


def test_a_path_may_be_a_string_and_the_file_new(tmp_path: Path) -> None:
    with atomic_write(str(tmp_path / "new.bin")) as file:
        file.write(b"x")
    assert names(tmp_path) == ["new.bin"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("old", [b"old", None])
def test_an_exception_leaves_everything_as_it_was(tmp_path: Path, error, old) -> None:
    path = tmp_path / "scene.bin"
    if old is not None:
        path.write_bytes(old)
    with pytest.raises(error), atomic_write(path) as file:
        file.write(b"half")
        raise error
    assert names(tmp_path) == ([] if old is None else ["scene.bin"])
    assert old is None or path.read_bytes() == old


def test_a_failed_rename_leaves_no_temporary_file(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "scene.bin"
    path.write_bytes(b"old")

    def fail(*paths) -> None:
        raise OSError("disk is full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk is full"), atomic_write(path) as file:
        file.write(b"new")
    assert names(tmp_path) == ["scene.bin"] and path.read_bytes() == b"old"


def test_content_reaches_the_disk_before_the_name_changes(tmp_path: Path, monkeypatch) -> None:
    done: list[str] = []
    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("sync"), sync(handle)))
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("rename"), replace(*paths)))
    with atomic_write(tmp_path / "a") as file:
        file.write(b"x")
    assert done == ["sync", "rename"]


def test_others_may_read_it_as_the_umask_says(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with atomic_write(tmp_path / "a") as file:
            file.write(b"x")
        assert os.umask(0o027) == 0o027  # left as it was
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_a_full_disk_names_the_file(tmp_path: Path, monkeypatch) -> None:
    def full(handle) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught, atomic_write(tmp_path / "a") as file:
        file.write(b"x")
    assert caught.value.filename == str(tmp_path / "a")
    assert names(tmp_path) == []


def test_what_killed_writers_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    for name in (".a.bin.x1.part", "sub/.b.bin.y2.part", "sub/b.bin", "part", ".hidden", "a.part"):
        (tmp_path / name).write_bytes(b"x")
    remove_parts(tmp_path)
    assert names(tmp_path) == [".hidden", "a.part", "part", "sub"]
    assert names(tmp_path / "sub") == ["b.bin"]


def test_a_missing_folder_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "nowhere" / "a"):
        pass
