"""A reader of .glb files by the glTF 2.0 specification, in numpy: scene graph, animation and skinning."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SIZES = {"SCALAR": (), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}


class Glb:
    """A file, its arrays and where its meshes are at a time."""

    def __init__(self, path: Path) -> None:
        content = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", content)
        assert (magic, version, length) == (b"glTF", 2, len(content))
        size, kind = struct.unpack_from("<I4s", content, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.json: dict[str, Any] = json.loads(content[20 : 20 + size])
        rest, kind = struct.unpack_from("<I4s", content, 20 + size)
        assert kind == b"BIN\0" and 28 + size + rest == length
        self.binary = content[28 + size :]
        assert self.json["buffers"] == [{"byteLength": len(self.binary)}]

    def array(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype, shape = np.dtype(_TYPES[accessor["componentType"]]), _SIZES[accessor["type"]]
        assert view["byteOffset"] % dtype.itemsize == 0
        count = accessor["count"] * int(np.prod(shape, dtype=int))
        assert count * dtype.itemsize == view["byteLength"]
        values = np.frombuffer(self.binary, dtype, count, view["byteOffset"]).reshape(-1, *shape)
        for name, reduce in (("min", np.min), ("max", np.max)):
            if name in accessor:
                assert np.array_equal(np.atleast_1d(reduce(values, axis=0)), np.float32(accessor[name]))
        return values.transpose(0, 2, 1) if accessor["type"] == "MAT4" else values

    def node(self, name: str) -> int:
        (found,) = [i for i, node in enumerate(self.json["nodes"]) if node.get("name") == name]
        return found

    def attributes(self, node: int) -> dict[str, np.ndarray]:
        (primitive,) = self.json["meshes"][self.json["nodes"][node]["mesh"]]["primitives"]
        return {name: self.array(index) for name, index in primitive["attributes"].items()}

    def times(self) -> np.ndarray:
        return self.array(self.json["animations"][0]["samplers"][0]["input"])

    def matrices(self, key: int | None) -> np.ndarray:
        """World matrices of all nodes at a key of the animation."""
        nodes = self.json["nodes"]
        moved: list[dict[str, Any]] = [dict(node) for node in nodes]
        if key is not None:
            (animation,) = self.json["animations"]
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                values = self.array(sampler["output"])
                if channel["target"]["path"] != "weights":
                    moved[channel["target"]["node"]][channel["target"]["path"]] = values[key]
        local = [_matrix(node) for node in moved]
        world = np.broadcast_to(np.eye(4), (len(nodes), 4, 4)).copy()

        def descend(node: int, above: np.ndarray) -> None:
            world[node] = above @ local[node]
            for child in nodes[node].get("children", ()):
                descend(child, world[node])

        for root in self.json["scenes"][0]["nodes"]:
            descend(root, np.eye(4))
        return world

    def vertices(self, node: int, key: int) -> np.ndarray:
        """Where the vertices of a node's mesh are at a key of the animation, world axes of glTF."""
        attributes, world = self.attributes(node), self.matrices(key)
        verts = attributes["POSITION"].astype(float)
        verts = verts + self._morphed(node, key)
        verts = np.column_stack([verts, np.ones(len(verts))])
        if "skin" not in self.json["nodes"][node]:
            return (verts @ world[node].T)[:, :3]
        skin = self.json["skins"][self.json["nodes"][node]["skin"]]
        bones = world[skin["joints"]] @ self.array(skin["inverseBindMatrices"])
        blend = np.einsum("vk,vkij->vij", attributes["WEIGHTS_0"], bones[attributes["JOINTS_0"]])
        return np.einsum("vij,vj->vi", blend, verts)[:, :3]

    def _morphed(self, node: int, key: int) -> np.ndarray | float:
        (primitive,) = self.json["meshes"][self.json["nodes"][node]["mesh"]]["primitives"]
        targets = [self.array(target["POSITION"]) for target in primitive.get("targets", ())]
        if not targets:
            return 0.0
        (animation,) = self.json["animations"]
        (channel,) = [c for c in animation["channels"] if c["target"] == {"node": node, "path": "weights"}]
        weights = self.array(animation["samplers"][channel["sampler"]]["output"])
        return np.einsum("m,mvi->vi", weights.reshape(-1, len(targets))[key], np.stack(targets))


def _matrix(node: dict[str, Any]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    matrix[:3, :3] *= np.asarray(node.get("scale", [1, 1, 1]))
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix
