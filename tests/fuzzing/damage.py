"""Damage that knows nothing of a file's contents: to its bytes, and to what stands in its place."""

from __future__ import annotations

import os
import random
from pathlib import Path


def damage_bytes(rng: random.Random, content: bytes) -> bytes:
    """One to four times: bits flipped, bytes set, a piece cut, put in, doubled, swapped or zeroed."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = _damaged(rng, data)
    return bytes(data)


def _damaged(rng: random.Random, data: bytearray) -> bytearray:
    size = len(data)
    if not size:
        return bytearray(rng.randbytes(rng.randrange(64)))
    # Headers say more than their share of the bytes.
    near = rng.randrange(min(size, 200)) if rng.random() < 0.5 else rng.randrange(size)
    length = min(size - near, rng.choice((1, 2, 4, 8, 64, 1000)))
    match rng.randrange(9):
        case 0 | 1:
            data[near] ^= 1 << rng.randrange(8)
        case 2:
            data[near : near + length] = rng.randbytes(length)
        case 3:
            data[near : near + length] = bytes([rng.choice((0, 0xFF, 0x7F, 0x80))]) * length
        case 4:
            return data[:near]
        case 5:
            del data[near : near + length]
        case 6:
            data[near:near] = rng.choice((rng.randbytes(length), data[:length], b"\0" * length))
        case 7:
            data[near:near] = data[near : near + length]
        case 8:
            other = rng.randrange(size - length + 1)
            data[near : near + length], data[other : other + length] = (
                data[other : other + length],
                data[near : near + length],
            )
    return data


def displace(rng: random.Random, path: Path) -> None:
    """Something else in a file's place: nothing, an empty file, a folder, a pipe, a device, a link."""
    content = path.read_bytes()
    path.unlink()
    match rng.randrange(9):
        case 0:
            path.touch()
        case 1:
            path.mkdir()
        case 2:
            os.mkfifo(path)
        case 3:
            path.symlink_to("/dev/zero")
        case 4:
            path.symlink_to(path.with_name("nothing"))
        case 5:
            path.symlink_to(path.name)
        case 6:
            path.write_bytes(content * 2)
        case 7:
            path.with_name(
                rng.choice(("x", " ", "a\nb", "x" * 200, "é\x01", "\udcff")) + path.suffix
            ).write_bytes(content)
        case _:
            pass
