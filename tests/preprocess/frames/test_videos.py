"""Videos of every kind that is read, and files that FFmpeg would take for one and follow elsewhere."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import av
import numpy as np
import pytest

from bigs.checks import InputError, check_pixels
from bigs.preprocess.frames import source
from bigs.preprocess.frames.source import open_source


def write(path: Path, codec: str, frames: int = 3) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height = 64, 48
        stream.pix_fmt = "rgb8" if codec == "gif" else "yuv420p"
        for t in range(frames):
            picture = np.full((48, 64, 3), 40 * t, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=stream.pix_fmt)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("a.mp4", "mpeg4"),
        ("a.mov", "mpeg4"),
        ("a.m4v", "mpeg4"),
        ("a.mkv", "mpeg4"),
        ("a.webm", "libvpx"),
        ("a.avi", "mpeg4"),
        ("a.gif", "gif"),
        ("a.mpg", "mpeg1video"),
    ],
)
def test_kinds_of_videos(tmp_path: Path, name: str, codec: str) -> None:
    if name == "a.m4v":
        write(tmp_path / "a.mp4", codec)
        (tmp_path / "a.mp4").rename(tmp_path / name)
    else:
        write(tmp_path / name, codec)
    pictures = [pixels for _, pixels in open_source(tmp_path / name).pictures()]
    assert len(pictures) == 3 and pictures[0].shape == (48, 64, 3)
    assert [round(float(pixels.mean()) / 40) for pixels in pictures] == [0, 1, 2]


PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\nfile:///etc/hostname\n#EXT-X-ENDLIST\n"
OTHERS: dict[str, Callable[[Path], object]] = {
    "a playlist": lambda path: path.write_bytes(PLAYLIST),
    "a list of files": lambda path: path.write_bytes(b"ffconcat version 1.0\nfile /etc/hostname\n"),
    "a picture": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(64)),
    "text": lambda path: path.write_bytes(b"hello"),
    "nothing": lambda path: path.write_bytes(b""),
    "a head alone": lambda path: path.write_bytes(b"\x00\x00\x00\x18ftypmp42" + bytes(100)),
    "a pipe": lambda path: os.mkfifo(path),
    "a device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("what", OTHERS)
def test_what_is_no_video(tmp_path: Path, what: str) -> None:
    path = tmp_path / "a.mp4"
    OTHERS[what](path)
    with pytest.raises(InputError, match=r"a\.mp4: expected a .*video.*found") as caught:
        list(open_source(path).pictures())
    assert len(str(caught.value).splitlines()) == 1


def test_too_many_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.mp4", "mpeg4", frames=5)
    monkeypatch.setattr(source, "_MAX_FRAMES", 4)
    with pytest.raises(InputError, match=r"a\.mp4: expected at most 4 frames, found more"):
        list(open_source(tmp_path / "a.mp4").pictures())


def test_too_many_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.mp4", "mpeg4")
    monkeypatch.setattr(source, "check_pixels", partial(check_pixels, most=1000))
    with pytest.raises(InputError, match=r"a\.mp4: expected at most 1000 pixels, found 64 x 48"):
        open_source(tmp_path / "a.mp4")
