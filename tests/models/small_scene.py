"""A little scene with coarse fields, and the covariance of a Gaussian: what the tests of models share."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
import trimesh
from torch import Tensor

from bigs.fields.decoders import DecoderConfig
from bigs.fields.triplane import TriplaneConfig
from bigs.geometry.distance import DistanceField
from bigs.geometry.rotations import axis_angle_to_matrix, quat_to_matrix
from bigs.geometry.surface import DistanceGrid, empty_grid
from bigs.hand import HandModel, builtin_hand
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.models.lighting import Lighting
from bigs.models.object_splats import ObjectSplats, ObjectSplatsConfig
from bigs.models.occlusion import measure_occlusion
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import ObjectSurface, Scene
from bigs.types import Gaussians

FRAMES = 4
TRIPLANE = TriplaneConfig(features=2, resolution=8)
DECODERS = DecoderConfig(appearance_width=8, geometry_width=8, skinning_width=8)
HAND = HandSplatsConfig(triplane=TRIPLANE, decoders=DECODERS, subdivisions=0)
OBJECT = ObjectSplatsConfig(triplane=TRIPLANE, decoders=DECODERS)
OBJECT_RADIUS = 0.04


@cache
def hand_model(rich: bool = False) -> HandModel:
    """The built-in right hand; `rich` adds pose correctives and a mean pose, lest zeros be tested."""
    model = builtin_hand("right")
    if not rich:
        return model
    generator = torch.Generator().manual_seed(7)
    fields = dict(model.named_buffers())
    fields["posedirs"] = 1e-3 * torch.randn(model.posedirs.shape, generator=generator)
    fields["hands_mean"] = 0.2 * torch.randn(15, 3, generator=generator)
    return HandModel("right", **fields)


def rotations(*shape: int, angle: float = 0.5, seed: int = 0) -> Tensor:
    """Random rotations [*shape, 3, 3], the largest by about twice `angle`."""
    generator = torch.Generator().manual_seed(seed)
    return axis_angle_to_matrix(angle * torch.randn(*shape, 3, generator=generator))


def disturb(module: torch.nn.Module, amount: float = 0.1, seed: int = 0) -> None:
    """Move every parameter away from its start."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += amount * torch.randn(parameter.shape, generator=generator)


def covariances(gaussians: Gaussians) -> Tensor:
    """R diag(s^2) R^T [..., N, 3, 3]."""
    axes = quat_to_matrix(gaussians.quats) * gaussians.scales[..., None, :]
    return axes @ axes.mT


def object_splats(config: ObjectSplatsConfig = OBJECT, count: int = 60) -> ObjectSplats:
    """A ball of `count` Gaussians with a colour gradient."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - z * z)
    normals = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)
    return ObjectSplats(OBJECT_RADIUS * normals, normals, 0.5 + 0.4 * normals, config)


def make_scene(
    *,
    shared: bool = True,
    lighting: bool = True,
    with_object: bool = True,
    rich: bool = False,
    sides: tuple[str, ...] = ("right", "left"),
    seed: int = 0,
) -> Scene:
    """Every parameter is away from its start, so that no term of the composition is neutral."""
    torch.manual_seed(seed)
    model = hand_model(rich)
    owners = ("right",) if shared and sides else sides
    ball = trimesh.creation.icosphere(subdivisions=1, radius=OBJECT_RADIUS)
    grid = empty_grid(np.full(3, -0.06), np.full(3, 0.06), 12)
    distance = np.linalg.norm(grid.points(), axis=-1) - OBJECT_RADIUS
    parts = {
        "object_splats": object_splats(),
        "object_poses": ObjectPoses(
            rotations(FRAMES, seed=3), torch.tensor([0.02, 0.01, 0.6]) + 0.05 * torch.rand(FRAMES, 3)
        ),
        "object_surface": ObjectSurface(
            torch.as_tensor(ball.vertices.copy(), dtype=torch.float32), torch.as_tensor(ball.faces.copy())
        ),
        "object_distance": DistanceField(
            DistanceGrid(distance.reshape(grid.values.shape), grid.origin, grid.spacing)
        ),
    }
    entities = (*sides, "object") if with_object else sides
    scene = Scene(
        K=torch.tensor([[200.0, 0.0, 60.0], [0.0, 210.0, 50.0], [0.0, 0.0, 1.0]]),
        width=120,
        height=100,
        hand_splats={side: HandSplats(model, HAND) for side in owners},
        betas={side: 0.5 * torch.randn(10) for side in owners},
        hand_poses={
            side: HandPoses(
                rotations(FRAMES, seed=10 + i),
                rotations(FRAMES, 15, angle=0.2, seed=20 + i),
                torch.tensor([0.1 - 0.2 * i, 0.0, 0.7]) + 0.05 * torch.rand(FRAMES, 3),
            )
            for i, side in enumerate(sides)
        },
        lighting=Lighting(entities, FRAMES) if lighting else None,
        **(parts if with_object else dict.fromkeys(parts)),
    )
    disturb(scene, 0.1, seed=seed + 1)
    if lighting:
        measure_occlusion(scene)
    return scene
