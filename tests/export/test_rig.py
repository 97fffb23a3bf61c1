"""The animated glTF: skinning, correctives and interpolation, evaluated by a reader of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from glb_reader import Glb
from scipy.spatial.transform import Rotation

from bigs.export.gltf import linear_color
from bigs.export.rig import RigidMesh, SkinnedHand, save_rig

T, V, K = 7, 30, 4
F = np.diag([1.0, -1.0, -1.0])
LENS = {
    "K": np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]),
    "width": 640,
    "height": 480,
    "fps": 25.0,
}


def random_hand(rng: np.random.Generator, correctives: int) -> SkinnedHand:
    """A chain of K joints; each vertex hangs on two."""
    weights = np.zeros((V, K))
    for v in range(V):
        weights[v, rng.choice(K, 2, replace=False)] = rng.dirichlet([1, 1])
    verts = rng.normal(size=(V, 3)) * 0.1
    if correctives:
        shapes = 0.01 * rng.normal(size=(correctives, V, 3))
        verts = verts + np.einsum("tm,mvi->tvi", rng.normal(size=(T, correctives)), shapes)
    return SkinnedHand(
        verts=verts,
        faces=np.arange(V).reshape(-1, 3),
        colors=rng.random((V, 3)),
        lbs_weights=weights,
        rest_joints=rng.normal(size=(K, 3)) * 0.1,
        parents=(-1, 0, 1, 2),
        joint_names=("wrist", "a", "b", "c"),
        rotations=Rotation.random(T * K, random_state=3).as_matrix().reshape(T, K, 3, 3),
        wrist=rng.normal(size=(T, 3)),
    )


def skinned(hand: SkinnedHand, t: int) -> np.ndarray:
    """sum_k w_k G_k v, with G_k the motion of joint k away from rest."""
    rest = hand.verts if hand.verts.ndim == 2 else hand.verts[t]
    turn, place, moved = np.eye(3), hand.wrist[t], np.zeros_like(rest)
    for k in range(K):
        if k:
            place = place + turn @ (hand.rest_joints[k] - hand.rest_joints[k - 1])
        turn = turn @ hand.rotations[t, k]
        moved += hand.lbs_weights[:, k : k + 1] * ((rest - hand.rest_joints[k]) @ turn.T + place)
    return moved


@pytest.mark.parametrize("correctives", [0, 3])
def test_vertices_are_where_skinning_puts_them(tmp_path: Path, correctives: int) -> None:
    hand = random_hand(np.random.default_rng(correctives), correctives)
    save_rig(tmp_path / "a.glb", {"left": hand}, None, **LENS)
    glb = Glb(tmp_path / "a.glb")
    (primitive,) = glb.json["meshes"][0]["primitives"]
    assert len(primitive.get("targets", ())) == correctives
    for t in range(T):
        found = glb.vertices(glb.node("left hand"), t) @ F
        np.testing.assert_allclose(found, skinned(hand, t), atol=2e-4 if correctives else 2e-6)


def test_the_object_moves_rigidly(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    turns = Rotation.random(T, random_state=1).as_matrix()
    obj = RigidMesh(
        rng.normal(size=(V, 3)),
        np.arange(V).reshape(-1, 3),
        rng.random((V, 3)),
        turns,
        rng.normal(size=(T, 3)),
        0.3,
    )
    save_rig(tmp_path / "a.glb", {}, obj, **LENS)
    glb = Glb(tmp_path / "a.glb")
    for t in range(T):
        wanted = 0.3 * obj.verts @ turns[t].T + obj.transl[t]
        np.testing.assert_allclose(glb.vertices(glb.node("object"), t) @ F, wanted, atol=1e-6)
    np.testing.assert_allclose(glb.times(), np.arange(T) / 25.0, atol=1e-7)
    assert glb.json["cameras"][0]["perspective"]["yfov"] == pytest.approx(2 * np.arctan(240 / 500))


def test_neighbouring_keys_take_the_short_way(tmp_path: Path) -> None:
    """Interpolation goes wrong where q follows -q, though both are the same turn."""
    angles = np.linspace(0, 4 * np.pi, 60)
    turns = Rotation.from_rotvec(angles[:, None] * [0, 0, 1.0]).as_matrix()
    obj = RigidMesh(np.eye(3), np.array([[0, 1, 2]]), np.ones((3, 3)), turns, np.zeros((60, 3)), 1.0)
    save_rig(tmp_path / "a.glb", {}, obj, **LENS)
    glb = Glb(tmp_path / "a.glb")
    (sampler,) = [
        glb.json["animations"][0]["samplers"][c["sampler"]]
        for c in glb.json["animations"][0]["channels"]
        if c["target"]["path"] == "rotation"
    ]
    quats = glb.array(sampler["output"])
    assert (quats[1:] * quats[:-1]).sum(1).min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)


def test_only_four_bones_hold_a_vertex(tmp_path: Path) -> None:
    hand = random_hand(np.random.default_rng(2), 0)
    save_rig(tmp_path / "a.glb", {"right": hand}, None, **LENS)
    read = Glb(tmp_path / "a.glb")
    attributes = read.attributes(read.node("right hand"))
    assert attributes["JOINTS_0"].shape == attributes["WEIGHTS_0"].shape == (V, 4)
    np.testing.assert_allclose(attributes["WEIGHTS_0"].sum(1), 1.0, atol=1e-6)
    # A bone that does not pull is the first one, as the format demands.
    assert (attributes["JOINTS_0"][attributes["WEIGHTS_0"] == 0] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(attributes["NORMAL"], axis=1), 1.0, atol=1e-5)


def test_colours_become_linear() -> None:
    np.testing.assert_allclose(
        linear_color(np.array([0.0, 0.5, 1.0, 2.0])), [0.0, 0.21404, 1.0, 1.0], atol=1e-5
    )
