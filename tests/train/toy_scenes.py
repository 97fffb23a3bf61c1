"""A scene that is known exactly: a cube held between two flat hands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
import trimesh

from bigs.fields.triplane import TriplaneConfig
from bigs.geometry.distance import DistanceField
from bigs.geometry.rotations import axis_angle_to_matrix
from bigs.geometry.surface import empty_grid
from bigs.hand import HandModel, builtin_hand, mirror_points, mirror_rotation
from bigs.models.hand_splats import HandSplats, HandSplatsConfig
from bigs.models.lighting import Lighting
from bigs.models.object_splats import ObjectSplats, ObjectSplatsConfig
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import ObjectSurface, Scene
from bigs.types import Side

HALF = 0.04  # half the true cube's side, metres
CENTER = (0.01, -0.02, 0.5)
TINY = TriplaneConfig(features=2, resolution=8)


def cube_scene(models: Mapping[Side, HandModel], size: float = 1.0, frames: int = 3) -> Scene:
    """A cube seen at `size` times its true size (and depth), hands that touch the true cube's two sides.

    The right hand touches the side of larger x with the 30 vertices that reach furthest, the left the other.
    """
    half, center = size * HALF, size * torch.tensor(CENTER)
    grid = empty_grid(np.full(3, -2 * half), np.full(3, 2 * half), 48)
    corners = np.abs(grid.points()) - half
    # Exact distance of a box: outside its corners' excess, inside the nearest side.
    distance = np.linalg.norm(corners.clip(0), axis=1) + corners.max(axis=1).clip(max=0)
    grid = type(grid)(distance.reshape(grid.values.shape), grid.origin, grid.spacing)
    cube = trimesh.creation.box((2 * half,) * 3)
    points, face = trimesh.sample.sample_surface_even(cube, 200, seed=0)

    still = torch.eye(3).repeat(frames, 1, 1)
    right = models["right"]
    config = HandSplatsConfig(triplane=TINY, subdivisions=0)
    fingers = torch.eye(3).repeat(frames, 15, 1, 1)
    rest = right(torch.zeros(10), fingers[:1], still[:1], torch.zeros(1, 3)).vertices[0]
    reach = rest[:, 0].topk(30, largest=False).values.mean()
    inward = rest[rest[:, 0].topk(30, largest=False).indices].mean(0)
    # The touching part lies on the middle of the side.
    wrist = torch.tensor(CENTER) + torch.stack([HALF - reach, -inward[1], -inward[2]])
    mirrored = torch.tensor(CENTER) + mirror_points(wrist - torch.tensor(CENTER))
    wrists = {"right": wrist.repeat(frames, 1), "left": mirrored.repeat(frames, 1)}
    return Scene(
        K=torch.tensor([[100.0, 0.0, 40.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]]),
        width=80,
        height=60,
        hand_splats={"right": HandSplats(right, config)},
        betas={"right": torch.zeros(10)},
        hand_poses={
            side: HandPoses(still.clone(), fingers.clone(), wrists[side]) for side in ("right", "left")
        },
        object_splats=ObjectSplats(
            np.asarray(points),
            np.asarray(cube.face_normals[face]),
            np.full((len(points), 3), 0.5),
            ObjectSplatsConfig(triplane=TINY),
        ),
        object_poses=ObjectPoses(still.clone(), center.repeat(frames, 1)),
        object_surface=ObjectSurface(
            torch.as_tensor(cube.vertices, dtype=torch.float32), torch.as_tensor(np.array(cube.faces))
        ),
        object_distance=DistanceField(grid),
        lighting=Lighting(("right", "left", "object"), frames),
    )


def turning_scene(wander: float = 0.0, frames: int = 24, turn: float = 2.0) -> Scene:
    """The cube turns by `turn` radians about the camera's vertical, and hands that hold it turn with it.

    The hands' estimates wander by `wander` metres.
    """
    scene = cube_scene({side: builtin_hand(side) for side in ("right", "left")}, frames=frames)
    angle = torch.linspace(0, turn, frames)
    rotations = axis_angle_to_matrix(torch.stack([0 * angle, angle, 0 * angle], -1))
    noise = wander * torch.randn(frames, 3, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        scene.object_poses.base_orient.copy_(rotations)
        centers = scene.at(torch.arange(frames)).object.centers
        for side in scene.sides:
            poses = scene.hand_poses[side]
            away = (rotations @ (poses.position(torch.tensor([0])) - centers[:1])[0][..., None])[..., 0]
            poses.base_orient.copy_(mirror_rotation(rotations) if side == "left" else rotations)
            poses.position.restart(centers + away + noise)
    return scene
