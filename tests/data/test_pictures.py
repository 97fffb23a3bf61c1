"""Pictures that are something else, or far too large."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import pytest
from PIL import Image

from bigs.checks import InputError
from bigs.data.images import open_picture, read_image, read_mask


def png_of(width: int, height: int) -> bytes:
    """A PNG whose header announces a size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(9000, 9000), (12_000, 12_000), (60_000, 60_000)])
def test_pictures_of_too_many_pixels(size: tuple[int, int], tmp_path: Path) -> None:
    file = tmp_path / "0000.png"
    file.write_bytes(png_of(*size))
    for read in (read_image, read_mask):
        with pytest.raises(InputError, match=r"0000.png: expected .* 67108864 pixels"):
            read(file)


@pytest.mark.parametrize("form", ["EPS", "GIF", "PPM", "ICO", "PDF"])
def test_other_formats_by_the_name_of_one_of_ours(form: str, tmp_path: Path) -> None:
    file = tmp_path / "0000.png"
    Image.new("RGB", (16, 16)).save(file, form)
    with pytest.raises(InputError, match=r"0000.png: expected a readable image, found a file that is not an"):
        read_image(file)
    with pytest.raises(InputError, match="PNG, JPEG, WEBP"), open_picture(file):
        pass


def test_what_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    (tmp_path / "folder.png").mkdir()
    kinds = {"pipe": "a pipe", "zero": "a device", "folder": "a folder", "none": "no such"}
    for name, words in kinds.items():
        with pytest.raises(InputError, match=f"{name}.png: expected an image, found {words}"):
            read_image(tmp_path / f"{name}.png")


def test_pictures_of_8k_are_read(tmp_path: Path) -> None:
    file = tmp_path / "0000.png"
    Image.new("1", (7680, 4320)).save(file)
    with open_picture(file) as image:
        assert image.size == (7680, 4320)
