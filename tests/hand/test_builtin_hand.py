from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh

from bigs.hand import HandModel, builtin_hand, load_hand_models
from bigs.hand.builtin import FILE
from tools.builtin_hand.anatomy import (
    FINGERS,
    WRIST,
    chain_points,
    finger_distance,
    hand_distance,
    rest_joints,
)
from tools.builtin_hand.arrays import right_hand_arrays

FINGER_OF_SHAPE = {"thumb": 5, "pinky": 8}


@pytest.fixture(scope="module")
def mesh(right: HandModel) -> trimesh.Trimesh:
    return trimesh.Trimesh(right.v_template.numpy(), right.faces.numpy(), process=False)


def test_the_file_is_what_its_script_makes() -> None:
    made = right_hand_arrays()
    with np.load(FILE) as stored:
        assert set(stored) == set(made)
        for name, values in stored.items():
            np.testing.assert_allclose(values, made[name], rtol=0, atol=1e-6, err_msg=name)


def test_is_one_closed_outward_surface(mesh: trimesh.Trimesh) -> None:
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.body_count == 1
    assert mesh.volume > 0
    assert 700 <= len(mesh.vertices) <= 1200


def test_triangles_are_well_shaped(mesh: trimesh.Trimesh) -> None:
    assert np.degrees(mesh.face_angles.min()) > 20


def test_vertices_lie_on_the_skin(mesh: trimesh.Trimesh) -> None:
    assert np.abs(hand_distance(mesh.vertices)).max() < 1e-4


def test_surface_does_not_cross_itself(mesh: trimesh.Trimesh) -> None:
    """Points just inside every face centre are inside, points just outside are outside."""
    centres, normals = mesh.triangles_center, mesh.face_normals
    assert (hand_distance(centres - 2e-3 * normals) < 0).all()
    assert (hand_distance(centres + 2e-3 * normals) > 0).all()


def test_is_a_hand_of_human_size_in_mano_axes(right: HandModel) -> None:
    joints = right.rest_joints(torch.zeros(10).double()).numpy()
    tips = right.v_template[right.tip_vertex_ids].numpy()
    np.testing.assert_allclose(joints[0], WRIST, atol=1e-6)
    assert 0.17 < np.linalg.norm(tips[2] - joints[0]) < 0.20
    assert (tips[1:, 0] < joints[0, 0] - 0.12).all()  # fingers towards -x
    assert tips[0, 2] == tips[:, 2].max()  # thumb towards +z
    assert tips[0, 1] < joints[0, 1]  # and on the palm's side, -y


def test_fingers_are_apart() -> None:
    names = ["index", "middle", "ring", "pinky"]
    for one, other in pairwise(names):
        points = chain_points(FINGERS[one])
        for point in (points[1], points[2], points[3]):
            assert finger_distance(point, FINGERS[other]) > 0.008


def test_skinning_weights(right: HandModel, mesh: trimesh.Trimesh) -> None:
    weights = right.lbs_weights
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights)).double(), atol=1e-6, rtol=0)
    assert (weights[right.tip_vertex_ids].argmax(1).tolist()) == [15, 3, 6, 12, 9]
    jump = np.abs(weights.numpy()[mesh.edges_unique[:, 0]] - weights.numpy()[mesh.edges_unique[:, 1]])
    assert jump.max() < 0.65
    # No vertex of one finger follows another finger, webs aside.
    fingers = weights[:, 1:].reshape(-1, 5, 3).sum(-1)
    assert (fingers.sort(1).values[:, -2] > 0.25).float().mean() < 0.02


def test_joint_regressor_gives_the_rest_joints(right: HandModel) -> None:
    regressor = right.J_regressor
    assert (regressor >= 0).all()
    torch.testing.assert_close(regressor.sum(1), torch.ones(16).double(), atol=1e-6, rtol=0)
    np.testing.assert_allclose((regressor @ right.v_template).numpy(), rest_joints(), atol=1e-6)


def test_size_scales_the_hand_about_the_wrist(right: HandModel) -> None:
    betas = torch.zeros(10).double()
    betas[0] = 1.0
    grown = right.rest_vertices(betas) - torch.from_numpy(WRIST)
    ratio = grown / (right.v_template - torch.from_numpy(WRIST))
    torch.testing.assert_close(ratio, torch.full_like(ratio, 1.04), atol=1e-3, rtol=0)


@pytest.mark.parametrize("finger", ["thumb", "pinky"])
def test_a_finger_length_direction_moves_that_finger_alone(right: HandModel, finger: str) -> None:
    moved = right.shapedirs[:, :, FINGER_OF_SHAPE[finger]].norm(dim=1)
    order = ["thumb", "index", "middle", "ring", "pinky"]
    tips = moved[right.tip_vertex_ids]
    assert tips.argmax() == order.index(finger)
    assert tips.max() > 0.004
    assert tips.sort().values[-2] < 1e-6


def test_shapes_are_different_directions(right: HandModel) -> None:
    flat = right.shapedirs.flatten(0, 1)
    assert torch.linalg.cond(flat / flat.norm(dim=0)) < 100


def test_flexion_brings_the_fingertips_to_the_palm(right: HandModel) -> None:
    flexed = torch.zeros(1, 15, 3).double()
    flexed[:, :12, 2] = 1.1
    still = torch.zeros(1, 15, 3).double()
    betas, eye = torch.zeros(10).double(), torch.eye(3).double()[None]
    wrist = torch.from_numpy(WRIST)[None]
    fist = right(betas, right.pose_matrices(flexed), eye, wrist).joints[0, 17:]
    flat = right(betas, right.pose_matrices(still), eye, wrist).joints[0, 17:]
    assert (fist[:, 1] < flat[:, 1] - 0.02).all()
    assert (fist[:, 0] > flat[:, 0] + 0.05).all()


def test_is_the_default_and_the_same_every_time(right: HandModel) -> None:
    hands = load_hand_models(None)
    assert torch.equal(hands["right"].v_template.double(), right.v_template)
    assert torch.equal(builtin_hand("left").v_template, hands["left"].v_template)
    assert hands["left"].side == "left"
