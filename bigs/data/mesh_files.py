"""Files of meshes and points, bounded before trimesh reads them: it trusts counts and follows names."""

from __future__ import annotations

import io
import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import trimesh
from PIL import Image

from bigs.checks import InputError, check_pixels, shown
from bigs.data.images import PICTURE_FORMATS
from bigs.files import MIB, read_bytes
from bigs.names import check_inside

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl", ".off")
# A scan of two million triangles has 100 MB.
_MAX_BYTES = 256 * MIB
_MAX_HEADER_BYTES, _MAX_PROPERTIES = 1 << 16, 1000
# trimesh makes a mesh of every material and group of an OBJ, each by a pass over all vertices.
_MAX_PARTS = 1000
# Limit of corners and vertices of a scene once each use of a mesh is written out.
_MAX_VALUES = 20_000_000
# Files beside a mesh: materials and textures.
_MAX_BESIDE, _MAX_BESIDE_BYTES = 64, 128 * MIB
_GLB_JSON = 0x4E4F534A
# Vertices and faces of an OBJ. A face's corner also names texture coordinates and normals after a slash.
_OBJ_LINES = re.compile(rb"^[ \t]*([vf][ \t].*)$", re.MULTILINE)
_OBJ_PARTS = re.compile(rb"^[ \t]*(?:usemtl|mtllib|[go])\b", re.MULTILINE)


def load_mesh_file(file: Path, what: str, load: Callable[..., Any], *, materials: bool = False) -> Any:
    """Load a file with trimesh, without merging anything.

    Args:
        file: one of `MESH_SUFFIXES`.
        what: what it should hold, for messages.
        load: `trimesh.load_mesh` or `trimesh.load`.
        materials: read materials and textures that lie in the same folder or below it, too; without them an
            OBJ has one part, which keeps its vertices as they are stored.

    Raises:
        InputError: no such file, no regular one, or trimesh cannot read it; or it announces more than it has.
    """
    content, kind = read_bytes(file, what, _MAX_BYTES), file.suffix.lower()
    if kind not in MESH_SUFFIXES:
        raise InputError(f"{file}: expected {what} ({', '.join(MESH_SUFFIXES)}), found suffix '{kind}'")
    try:
        if kind == ".ply":
            _check_ply(content)
        elif kind == ".glb":
            _check_glb(content)
        elif kind == ".obj":
            content = _checked_obj(content, materials=materials)
        return load(
            io.BytesIO(content),
            file_type=kind[1:],
            resolver=_Beside(file.parent),
            process=False,
            # With textures, a vertex on a seam becomes several.
            maintain_order=not materials,
            skip_materials=not materials,
        )
    except Exception as error:  # trimesh's readers raise many kinds of errors
        raise InputError(
            f"{file}: expected {what}, found {shown(str(error)) if str(error) else type(error).__name__}"
        ) from None


class _Beside(trimesh.resolvers.Resolver):
    """Files in the mesh's folder or below it: regular, bounded, and pictures only of the usual formats."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[str, bytes] = {}

    def get(self, name: str) -> bytes:
        if name not in self._read:
            path = self._folder / check_inside("mesh", name.strip())
            left = _MAX_BESIDE_BYTES - sum(map(len, self._read.values()))
            if len(self._read) >= _MAX_BESIDE:
                raise InputError(f"{path}: expected at most {_MAX_BESIDE} files beside a mesh, found more")
            most = min(left, MIB) if path.suffix == ".mtl" else left
            content = read_bytes(path, "a file that a mesh names", most)
            if path.suffix not in (".mtl", ".bin"):
                _check_picture(str(path), content)
            self._read[name] = content
        return self._read[name]

    def keys(self) -> list[str]:
        return list(self._read)

    def write(self, name: str, data: Any) -> None:
        raise InputError(f"{self._folder / name}: expected a mesh to be read only")

    def namespaced(self, namespace: str) -> _Beside:
        return _Beside(self._folder / check_inside("mesh", namespace))


def _check_picture(where: str, content: bytes) -> None:
    with Image.open(io.BytesIO(content), formats=PICTURE_FORMATS) as image:
        check_pixels(where, image.width, image.height)


def _check_ply(content: bytes) -> None:
    """Its elements have properties, each of at least a byte in every row."""
    end = content.find(b"end_header", 0, _MAX_HEADER_BYTES)
    if end < 0:
        raise ValueError("a PLY file without the end of its header")
    elements: list[tuple[str, int]] = []
    properties: list[int] = []
    for words in (line.split() for line in content[:end].decode("latin1").splitlines()):
        if words and "element" in words[0]:
            name, count = words[1:]
            elements.append((name, int(count)))
            properties.append(0)
        elif words and "property" in words[0]:
            properties[-1] += 1
    body = len(content) - end
    if sum(properties) > _MAX_PROPERTIES:
        raise ValueError(f"{sum(properties)} properties")
    for (name, rows), width in zip(elements, properties, strict=True):
        if rows < 0 or rows * max(width, 1) > body or (rows and not width):
            raise ValueError(f"element {shown(name)} of {shown(rows)} x {width} properties in {body} bytes")


def _checked_obj(content: bytes, *, materials: bool) -> bytes:
    if not materials:
        # A backslash continues a line.
        lines = _OBJ_LINES.findall(content.replace(b"\r\n", b"\n").replace(b"\\\n", b" "))
        return b"\n".join(line if line[:1] == b"v" else re.sub(rb"/\S*", b"", line) for line in lines)
    parts = len(_OBJ_PARTS.findall(content))
    if parts > _MAX_PARTS:
        raise ValueError(f"{parts} materials and groups, more than {_MAX_PARTS}")
    return content


def _check_glb(content: bytes) -> None:
    """Check a GLB: accessors within its bytes, a bounded number of mesh uses, and acceptable pictures."""
    _, _, _, size, kind = struct.unpack_from("<4sIIII", content)
    if kind != _GLB_JSON or 20 + size > len(content):
        raise ValueError("a GLB file without its description")
    document = json.loads(content[20 : 20 + size])
    counts = [int(accessor["count"]) for accessor in document.get("accessors", [])]
    if any(not 0 <= count <= len(content) for count in counts):
        raise ValueError(f"an accessor of {shown(max(counts))} elements in {len(content)} bytes")
    used = sum(
        counts[index]
        for node in document.get("nodes", [])
        if "mesh" in node
        for part in document["meshes"][node["mesh"]]["primitives"]
        for index in (*part["attributes"].values(), part.get("indices", part["attributes"]["POSITION"]))
    )
    if used > _MAX_VALUES:
        raise ValueError(f"{used} values, more than {_MAX_VALUES}")
    for image in document.get("images", []):
        if "bufferView" in image:
            view = document["bufferViews"][image["bufferView"]]
            start = 20 + size + 8 + int(view.get("byteOffset", 0))
            _check_picture("picture", content[start : start + int(view["byteLength"])])
