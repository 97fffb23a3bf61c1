"""A checksum of tensors and text, which reveals a changed bit in a file."""

from __future__ import annotations

import zlib
from collections.abc import Mapping

from torch import Tensor


def checksum(text: str, tensors: Mapping[str, Tensor]) -> str:
    """CRC-32 of a text and of every tensor's name, type, shape and bytes, as eight hexadecimal digits."""
    total = zlib.crc32(text.encode())
    for name, value in sorted(tensors.items()):
        total = zlib.crc32(f"{name} {value.dtype} {list(value.shape)}".encode(), total)
        total = zlib.crc32(value.contiguous().numpy().tobytes(), total)
    return f"{total:08x}"
