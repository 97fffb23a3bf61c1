"""The hands' Gaussians: one canonical right hand for both sides (paper section 3.2, Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.spatial
import torch
from torch import Tensor, nn

from bigs.fields.decoders import AppearanceDecoder, DecoderConfig, GeometryDecoder, SkinningDecoder
from bigs.fields.triplane import Triplane, TriplaneConfig
from bigs.geometry.arrays import float32
from bigs.geometry.mesh import frames_from_normals, midpoint_subdivision, point_spacing, vertex_normals
from bigs.geometry.rotations import matrix_to_quat, quat_multiply
from bigs.hand import HandModel
from bigs.hand.lbs import pose_corrective
from bigs.models.canonical import CanonicalHand


@dataclass(frozen=True)
class HandSplatsConfig:
    """How the hand is covered with Gaussians and how its field is built."""

    triplane: TriplaneConfig = field(default_factory=lambda: TriplaneConfig(features=16, resolution=128))
    decoders: DecoderConfig = field(default_factory=DecoderConfig)
    # Midpoint subdivisions of the template's mesh. The released code uses three (49k Gaussians); an image in
    # which the hand is 100 pixels long cannot show more than one.
    subdivisions: int = 1
    # Share one canonical hand (and one shape) between both sides; the paper's "share".
    shared: bool = True
    # Standard deviation of an estimate of betas that no second hand confirms; 0 trusts it entirely.
    shape_error: float = 0.6
    # The same of the first of betas, overall size, for either hand: a picture tells a small hand from a far
    # one by hardly anything. 0 treats it as the others, as does a `shape_error` of 0.
    size_error: float = 0.9
    # Let the geometry field offset, rotate and scale the Gaussians. The released code freezes them.
    learn_geometry: bool = True
    # Standard deviations at the start: along the surface in units of the local spacing, across it relative to
    # that.
    scale_per_spacing: float = 0.55
    flatness: float = 0.35
    opacity: float = 0.95
    max_offset: float = 0.003
    # The mean colour at the start; None takes what the pictures show of the hands. A stage may change it.
    color: tuple[float, float, float] | None = None


# A layer of Gaussians covers pictures to so many of its standard deviations above its centres: lines of sight
# that graze it pass many. On the mesh itself they would draw the hand wider than it is, and the hand would be
# put too far away to make up for it. (The object's follow no mesh.)
_REACH = 3.0

# The mean colour of light skin under white light, where nothing shows the hands.
_SKIN = (0.7, 0.55, 0.45)


class HandSplats(nn.Module):
    """A canonical right hand: Gaussians on the (subdivided) template surface, changed by triplane fields."""

    base_points: Tensor
    shapedirs: Tensor
    posedirs: Tensor
    base_weights: Tensor
    base_quats: Tensor
    base_log_scales: Tensor

    def __init__(
        self, model: HandModel, config: HandSplatsConfig, color: tuple[float, float, float] | None = None
    ) -> None:
        """`model` is the right hand; `color` the hands', if known, where the configuration has none."""
        super().__init__()
        self.model = model
        self.config = config
        points, faces = model.v_template.numpy().astype(np.float64), model.faces.numpy()
        follow = None
        for _ in range(config.subdivisions):
            step, faces = midpoint_subdivision(faces, len(points))
            points = step @ points
            follow = step if follow is None else step @ follow
        n_template = len(model.v_template)

        def carry(values: Tensor) -> Tensor:
            """Vertex attributes [V, ...] at the Gaussians."""
            if follow is None:
                return values.clone()
            flat = values.reshape(n_template, -1).numpy().astype(np.float64)
            return torch.from_numpy(follow @ flat).to(values.dtype).reshape(-1, *values.shape[1:])

        normals = vertex_normals(points, faces)
        spacing = point_spacing(points)
        sigma = config.scale_per_spacing * spacing
        inset = _REACH * config.flatness * sigma[:, None] * normals
        self.register_buffer("base_points", float32(points - inset), persistent=False)
        self.register_buffer("shapedirs", carry(model.shapedirs), persistent=False)
        if model.has_posedirs:
            self.register_buffer("posedirs", carry(model.posedirs), persistent=False)
        self.register_buffer(
            "base_weights", neighbour_weights(points, model.v_template, model.lbs_weights), persistent=False
        )
        self.register_buffer(
            "base_quats", matrix_to_quat(float32(frames_from_normals(normals))), persistent=False
        )
        base_scales = sigma[:, None] * np.array([1.0, 1.0, config.flatness])
        self.register_buffer("base_log_scales", float32(np.log(base_scales)), persistent=False)

        bounds = torch.stack([self.base_points.amin(0), self.base_points.amax(0)])
        margin = 0.02 * (bounds[1] - bounds[0])
        self.triplane = Triplane(config.triplane, torch.stack([bounds[0] - margin, bounds[1] + margin]))
        features = self.triplane.out_features
        self.appearance = AppearanceDecoder(features, config.decoders.appearance_width)
        self.geometry = GeometryDecoder(features, config.decoders.geometry_width, config.max_offset)
        self.skinning = SkinningDecoder(features, config.decoders.skinning_width)
        self.color = nn.Parameter(torch.logit(torch.tensor(config.color or color or _SKIN)))

    def forward(self) -> CanonicalHand:
        """Evaluate the fields once."""
        # The query points do not depend on the shape: the field belongs to the surface, not to space.
        features = self.triplane(self.base_points)
        appearance = self.appearance(
            features,
            self.color.expand(len(features), 3),
            torch.logit(features.new_tensor(self.config.opacity)).expand(len(features)),
        )
        points, quats, log_scales = self.base_points, self.base_quats, self.base_log_scales
        if self.config.learn_geometry:
            geometry = self.geometry(features)
            points = points + geometry.offsets
            quats = quat_multiply(matrix_to_quat(geometry.rotations), quats)
            log_scales = log_scales + geometry.log_scales
        return CanonicalHand(
            points,
            self.shapedirs,
            self.posedirs if self.model.has_posedirs else None,
            self.skinning(features, self.base_weights),
            quats,
            log_scales.exp(),
            appearance.opacities,
            appearance.colors,
        )


def rest_points(hand: CanonicalHand, betas: Tensor, hand_pose: Tensor) -> Tensor:
    """Shaped points [N, 3] before skinning, or [B, N, 3] where fingers [B, 15, 3, 3] correct them."""
    points = hand.points + hand.shapedirs @ betas
    return points if hand.posedirs is None else points + pose_corrective(hand.posedirs, hand_pose)


def neighbour_weights(points: np.ndarray, verts: Tensor, lbs_weights: Tensor, neighbours: int = 6) -> Tensor:
    """Pseudo ground truth of the LBS regulariser: distance-weighted mean over the 6 nearest vertices.

    A point that coincides with a vertex takes that vertex's weights.

    Returns:
        [N, 16], rows sum to one.
    """
    distance, index = scipy.spatial.cKDTree(verts.numpy()).query(points, k=neighbours)
    closeness = 1.0 / np.maximum(distance, 1e-6) ** 2
    closeness /= closeness.sum(axis=1, keepdims=True)
    blended = np.einsum("nk,nkj->nj", closeness, lbs_weights.numpy()[index])
    return torch.as_tensor(blended / blended.sum(axis=1, keepdims=True), dtype=torch.float32)
