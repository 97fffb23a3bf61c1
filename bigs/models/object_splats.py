"""The object's Gaussians: on the surface that the initial estimates give, changed by triplane fields."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from bigs.fields.decoders import AppearanceDecoder, DecoderConfig, GeometryDecoder
from bigs.fields.triplane import Triplane, TriplaneConfig
from bigs.geometry.arrays import float32
from bigs.geometry.mesh import frames_from_normals, point_spacing
from bigs.geometry.rotations import matrix_to_quat, quat_multiply
from bigs.models.canonical import CanonicalObject
from bigs.models.lighting import N_PARTS
from bigs.models.poses import ObjectFrames
from bigs.models.posing import object_part, pose_parts
from bigs.types import Gaussians


@dataclass(frozen=True)
class ObjectSplatsConfig:
    """How the object is covered with Gaussians and how its field is built."""

    triplane: TriplaneConfig = field(default_factory=lambda: TriplaneConfig(features=16, resolution=128))
    decoders: DecoderConfig = field(default_factory=DecoderConfig)
    # Gaussians at the start, spread evenly over the initial surface; the paper starts from at least 10000.
    n_gaussians: int = 6000
    scale_per_spacing: float = 0.6
    flatness: float = 0.35
    opacity: float = 0.95
    max_offset: float = 0.006
    # One scale for all three axes, as in the released code; the paper's Eq. 1 has three.
    isotropic: bool = False


class Anchors(NamedTuple):
    """Where the field is evaluated, and the N Gaussians that it changes there; buffers of `ObjectSplats`."""

    base_points: Tensor  # [N, 3] metres at the initial size
    normals: Tensor  # [N, 3] unit
    base_quats: Tensor  # [N, 4]
    base_log_scales: Tensor  # [N, 3]
    color_logits: Tensor  # [N, 3]
    weights: Tensor  # [N, 16], as in `CanonicalObject`


class ObjectSplats(nn.Module):
    """A canonical object: Gaussians on an initial surface, changed by triplane fields."""

    base_points: Tensor
    normals: Tensor
    base_quats: Tensor
    base_log_scales: Tensor
    color_logits: Tensor
    weights: Tensor

    def __init__(
        self, points: np.ndarray, normals: np.ndarray, colors: np.ndarray, config: ObjectSplatsConfig
    ) -> None:
        """Starts: points [N, 3] (metres), unit normals [N, 3] and colours [N, 3] in [0, 1]."""
        super().__init__()
        self.config = config
        sigma = config.scale_per_spacing * point_spacing(points)
        flatness = 1.0 if config.isotropic else config.flatness
        inset = flatness * sigma[:, None] * normals
        # Buffers, not constants: densification changes their length, so a checkpoint must carry them.
        self.register_buffer("base_points", float32(points - inset))
        self.register_buffer("normals", float32(normals))
        self.register_buffer("base_quats", matrix_to_quat(float32(frames_from_normals(normals))))
        scales = sigma[:, None] * np.array([1.0, 1.0, flatness])
        self.register_buffer("base_log_scales", float32(np.log(scales)))
        self.register_buffer("color_logits", torch.logit(float32(colors).clamp(0.02, 0.98)))

        self.register_buffer("weights", float32(region_weights(points, normals, N_PARTS)))
        bounds = torch.stack([self.base_points.amin(0), self.base_points.amax(0)])
        margin = 0.05 * (bounds[1] - bounds[0]) + config.max_offset
        self.triplane = Triplane(config.triplane, torch.stack([bounds[0] - margin, bounds[1] + margin]))
        features = self.triplane.out_features
        self.appearance = AppearanceDecoder(features, config.decoders.appearance_width)
        self.geometry = GeometryDecoder(features, config.decoders.geometry_width, config.max_offset)

    @property
    def anchors(self) -> Anchors:
        """Where the fields are evaluated now."""
        return Anchors(*(getattr(self, name) for name in Anchors._fields))

    def place(self, anchors: Anchors) -> None:
        """Evaluate the fields elsewhere from now on, at any number of places; they stay as they are."""
        for name, values in anchors._asdict().items():
            setattr(self, name, values)

    def forward(self) -> CanonicalObject:
        """Evaluate the fields once."""
        features = self.triplane(self.base_points)
        start = torch.logit(features.new_tensor(self.config.opacity)).expand(len(features))
        appearance = self.appearance(features, self.color_logits, start)
        geometry = self.geometry(features)
        log_scales = self.base_log_scales + (
            geometry.log_scales.mean(-1, keepdim=True) if self.config.isotropic else geometry.log_scales
        )
        return CanonicalObject(
            self.base_points + geometry.offsets,
            geometry.offsets,
            quat_multiply(matrix_to_quat(geometry.rotations), self.base_quats),
            log_scales.exp(),
            appearance.opacities,
            appearance.colors,
            self.normals,
            self.weights,
        )


def region_weights(points: np.ndarray, normals: np.ndarray, count: int) -> np.ndarray:
    """Smooth membership [N, count] of surface points [N, 3] in `count` even regions; rows sum to one.

    A region has a side: its width in metres is also how far apart opposite unit normals [N, 3] count.
    """
    # A region's share of the surface if the points lay on a sphere.
    width = 2.0 * float(np.sqrt(points.var(0).sum() * 4.0 / count))
    places = np.concatenate([points, width * normals], axis=1)
    anchors = [int(np.argmin(((places - places.mean(0)) ** 2).sum(1)))]
    nearest = np.full(len(places), np.inf)
    while len(anchors) < count:
        nearest = np.minimum(nearest, ((places - places[anchors[-1]]) ** 2).sum(1))
        anchors.append(int(nearest.argmax()))
    squared = ((places[:, None] - places[anchors]) ** 2).sum(-1)
    # Relative to the nearest anchor, so that distant points still belong to one.
    share = np.exp((squared.min(1, keepdims=True) - squared) / (2.0 * (0.5 * width) ** 2))
    return share / share.sum(1, keepdims=True)


def pose_object(obj: CanonicalObject, frames: ObjectFrames) -> Gaussians:
    """Carry the canonical Gaussians to B frames, in camera space."""
    return pose_parts([object_part(obj, frames)])
