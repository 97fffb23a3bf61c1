"""Ambient occlusion: how much of the sky hands and object cover for each other as they are posed."""

from __future__ import annotations

import torch
from torch import Tensor

from bigs.fused.occlusion import Discs, form_factors
from bigs.geometry.arrays import float32
from bigs.geometry.mesh import face_areas, sample_surface
from bigs.models.scene import Scene
from bigs.types import Entity, Side

# Samples of the object's surface. A hand has its vertices.
_SAMPLES = 1000


@torch.no_grad()
def measure_occlusion(scene: Scene) -> None:
    """Measure anew what covers the sky above each subject of a lit scene in every frame.

    A hand covers the object, the other hand and itself. The object covers hands only: what it covers of
    itself never changes, so its albedo holds it.
    """
    assert scene.lighting is not None
    posed = scene.at(torch.arange(scene.n_frames))
    places: dict[Entity, Tensor] = {}
    discs: dict[Entity, Discs] = {}
    for side in scene.sides:
        places[side] = scene.hand_model(side).v_template.clone()
        discs[side] = _hand(scene, side, posed.verts(side))
    surface = scene.object_surface
    if surface is not None:
        verts, faces = surface.verts.double().numpy(), surface.faces.numpy()
        points, normals = map(float32, sample_surface(verts, faces, _SAMPLES))
        area = float(face_areas(verts, faces).sum() * posed.object.scale**2 / len(points))
        turned = normals @ posed.object.rotations.transpose(-1, -2)
        places["object"] = points
        discs["object"] = Discs(posed.object_points(points), turned, points.new_full((len(points),), area))
    for entity, own in discs.items():
        covering = [other for name, other in discs.items() if entity != "object" or name != "object"]
        covered = own.points.new_zeros(own.points.shape[:-1])
        for other in covering:
            covered += form_factors(own.points, own.normals, other)
        # Discs hide each other as if at random.
        scene.lighting.occlusion[entity].place(places[entity], -torch.expm1(-covered))


def _hand(scene: Scene, side: Side, verts: Tensor) -> Discs:
    """A hand's vertices [T, V, 3] as discs, each with a third of the triangles around it."""
    faces = scene.hand_model(side).faces_of(side)
    a, b, c = verts[:, faces].unbind(2)
    across = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(verts)
    for corner in faces.unbind(-1):
        normals.index_add_(1, corner, across)
    thirds = across[0].norm(dim=-1) / 6.0
    areas = verts.new_zeros(verts.shape[1])
    for corner in faces.unbind(-1):
        areas.index_add_(0, corner, thirds)
    return Discs(verts, torch.nn.functional.normalize(normals, dim=-1), areas)
