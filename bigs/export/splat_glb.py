"""Gaussians as glTF, extension KHR_gaussian_splatting (ratified): points with a shape, kernel "ellipse"."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from bigs.export.gltf import Gltf, linear_color
from bigs.export.ply import SH_C0, check_splats
from bigs.geometry.rotations import quat_multiply
from bigs.types import Entity, Gaussians

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0


def save_splat_glb(path: str | Path, parts: Mapping[Entity, Gaussians]) -> None:
    """Write sets of Gaussians, each under a node of its name; `path` is whole or absent.

    The file has glTF's axes (y up). Viewers without the extension show coloured points.

    Args:
        path: the .glb file.
        parts: subject -> means [N, 3] metres, colours [N, 3], OpenCV camera axes.

    Raises:
        InputError: a shape does not fit, or a value is not finite.
    """
    document = Gltf()
    document.use(EXTENSION)
    nodes = []
    for name, gaussians in parts.items():
        check_splats(f"{path}: {name}", gaussians)
        means, quats, scales, opacities, colors = (
            values.detach().cpu().double().numpy() for values in opengl_axes(gaussians)
        )
        opacities = np.clip(opacities, 0.0, 1.0)
        attributes = {
            "POSITION": document.vertices(means, bounds=True),
            "COLOR_0": document.vertices(np.column_stack([linear_color(colors), opacities])),
            f"{EXTENSION}:ROTATION": document.vertices(np.roll(quats, -1, axis=1)),
            f"{EXTENSION}:SCALE": document.vertices(scales),
            f"{EXTENSION}:OPACITY": document.vertices(opacities),
            f"{EXTENSION}:SH_DEGREE_0_COEF_0": document.vertices((colors - 0.5) / SH_C0),
        }
        shape = {
            "kernel": "ellipse",
            "colorSpace": "srgb_rec709_display",
            "projection": "perspective",
            "sortingMethod": "cameraDistance",
        }
        primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: shape}}
        mesh = document.add("meshes", name=name, primitives=[primitive])
        nodes.append(document.add("nodes", name=name, mesh=mesh))
    document.add("scenes", nodes=nodes)
    document.save(path)


def opengl_axes(gaussians: Gaussians) -> Gaussians:
    """Gaussians given in OpenCV's axes, in those with y up and z towards the viewer; unit quaternions."""
    half_turn_about_x = gaussians.quats.new_tensor([0.0, 1.0, 0.0, 0.0])
    quats = quat_multiply(half_turn_about_x.expand_as(gaussians.quats), gaussians.quats)
    # The zero quaternion stands for no rotation.
    still = quats.new_tensor([0.0, 1.0, 0.0, 0.0])
    length = quats.norm(dim=-1, keepdim=True)
    quats = torch.where(length > 0, quats / length.clamp_min(1e-30), still)
    return gaussians._replace(
        means=gaussians.means * gaussians.means.new_tensor([1.0, -1.0, -1.0]), quats=quats
    )
