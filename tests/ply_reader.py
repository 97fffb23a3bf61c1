"""A reader of binary PLY files by the format's specification, sharing no code with the writer."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np


def read_ply(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Vertex properties and triangles of a binary little-endian PLY, by the format's specification."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in header.decode().splitlines()]
    assert lines[0] == ["ply"] and lines[1] == ["format", "binary_little_endian", "1.0"]
    codes = {"float": "f", "double": "d", "uchar": "B", "int": "i", "uint": "I"}
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in lines[2:]:
        if line[0] == "element":
            elements.append((line[1], int(line[2]), []))
        elif line[0] == "property":
            elements[-1][2].append(line[1:])
    assert elements[0][0] == "vertex"
    _, count, properties = elements[0]
    row = struct.Struct("<" + "".join(codes[kind] for kind, _ in properties))
    table = np.array([row.unpack_from(body, row.size * i) for i in range(count)])
    vertices = {name: table[:, i] for i, (_, name) in enumerate(properties)}
    rest = body[row.size * count :]
    if len(elements) == 1:
        assert rest == b""
        return vertices, None
    _, faces, ((_, kind, item, _),) = elements[1]
    row = struct.Struct(f"<{codes[kind]}3{codes[item]}")
    triangles = np.array([row.unpack_from(rest, row.size * i) for i in range(faces)])
    assert (triangles[:, 0] == 3).all() and len(rest) == row.size * faces
    return vertices, triangles[:, 1:]


def positions(vertices: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([vertices[axis] for axis in "xyz"], axis=-1)
