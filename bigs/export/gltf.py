"""A glTF 2.0 document in the making, and its binary form (.glb)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from bigs.atomic import atomic_write

_COMPONENTS = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}
_KINDS = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942


class Gltf:
    """Collects arrays and the objects that refer to them by index."""

    def __init__(self) -> None:
        self._document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "bigs"}}
        self._bytes = bytearray()

    def add(self, collection: str, **item: Any) -> int:
        """Append an object to "nodes", "meshes", ... and return its index there."""
        items = self._document.setdefault(collection, [])
        items.append(item)
        return len(items) - 1

    def amend(self, collection: str, index: int, **more: Any) -> None:
        """Add to an object that is there already."""
        self._document[collection][index].update(more)

    def use(self, extension: str) -> None:
        used = self._document.setdefault("extensionsUsed", [])
        if extension not in used:
            used.append(extension)

    def array(self, values: np.ndarray, *, bounds: bool = False, target: int | None = None) -> int:
        """Store an array as an accessor.

        Args:
            values: [N], [N, 2], [N, 3], [N, 4] or [N, 4, 4] of little-endian float32 or unsigned integers;
                matrices act on columns.
            bounds: state the smallest and the largest value, as positions and times must.
            target: what the array is for (`vertices` and `indices` know).
        """
        values = np.ascontiguousarray(values)
        kind = _KINDS[values.shape[1:]]
        # glTF stores matrices column by column.
        content = values.transpose(0, 2, 1).tobytes() if kind == "MAT4" else values.tobytes()
        self._bytes.extend(b"\0" * (-len(self._bytes) % 4))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._bytes), "byteLength": len(content)}
        self._bytes.extend(content)
        if target is not None:
            view["target"] = target
        accessor: dict[str, Any] = {
            "bufferView": self.add("bufferViews", **view),
            "componentType": _COMPONENTS[values.dtype.str[1:]],
            "count": len(values),
            "type": kind,
        }
        if bounds:
            flat = values.reshape(len(values), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        return self.add("accessors", **accessor)

    def vertices(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Store float32 values, one row a vertex."""
        return self.array(values.astype("<f4"), bounds=bounds, target=_ARRAY_BUFFER)

    def bytes_per_vertex(self, values: np.ndarray) -> int:
        """Store small integers [N, 4], one row a vertex."""
        return self.array(values.astype("u1"), target=_ARRAY_BUFFER)

    def indices(self, faces: np.ndarray) -> int:
        """Store the corners of triangles [F, 3]."""
        return self.array(faces.reshape(-1).astype("<u4"), target=_ELEMENT_ARRAY_BUFFER)

    def save(self, path: str | Path) -> None:
        """Write a .glb; `path` is whole or absent."""
        binary = bytes(self._bytes) + b"\0" * (-len(self._bytes) % 4)
        document = self._document | {"buffers": [{"byteLength": len(binary)}]}
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(binary)
        with atomic_write(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, length))
            file.write(struct.pack("<II", len(text), _JSON_CHUNK) + text)
            file.write(struct.pack("<II", len(binary), _BINARY_CHUNK) + binary)


def linear_color(srgb: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] as screens show them, as the linear light that glTF's vertex colours are (sRGB)."""
    srgb = np.clip(srgb, 0.0, 1.0)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
