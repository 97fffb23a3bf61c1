"""The synthetic clip: its pictures, its ground truth and its errors agree with each other."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_ground_truth
from bigs.data.synthetic import OBJECT_KINDS, make_clip
from bigs.data.synthetic.grasp import find_grasp, pose_hand
from bigs.data.synthetic.objects import make_object
from bigs.hand import HandModel
from bigs.types import MASK_VALUES, SIDES, Side


@pytest.fixture(scope="module")
def clip(synthetic_clip: Path) -> Clip:
    return load_hold(synthetic_clip)


@pytest.fixture(scope="module")
def truth(synthetic_clip: Path) -> dict[str, np.ndarray]:
    with np.load(synthetic_clip / "gt.npz") as stored:
        return {key: stored[key] for key in stored.files}


def splat(clip: Clip, points: np.ndarray) -> np.ndarray:
    """The pixels [H, W] that contain the projections of points [N, 3], camera frame."""
    pixels = points @ clip.K.T
    column, row = np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int).T
    assert column.min() >= 0 and column.max() < clip.width and row.min() >= 0 and row.max() < clip.height
    hit = np.zeros((clip.height, clip.width), dtype=bool)
    hit[row, column] = True
    return hit


def test_projected_truth_agrees_with_the_masks(clip: Clip, synthetic_clip: Path) -> None:
    truth = load_ground_truth(synthetic_clip)
    assert truth.object_verts is not None
    for t in range(0, len(clip), 5):
        mask = clip.mask(t)
        entities = {**{side: truth.verts[side][t] for side in SIDES}, "object": truth.object_verts[t]}
        shown = scipy.ndimage.binary_dilation(mask > 0)
        for entity, verts in entities.items():
            hit = splat(clip, verts)
            # Vertices lie inside the foreground, and what is labelled is close to a vertex.
            assert shown[hit].mean() > 0.99
            near = scipy.ndimage.binary_dilation(hit, iterations=4)
            assert near[mask == MASK_VALUES[entity]].mean() > 0.99


def test_every_entity_is_seen(clip: Clip) -> None:
    for entity in MASK_VALUES:
        assert clip.has_pixels(entity).all()
        assert clip.mask_areas[entity].mean() > 0.02 * clip.width * clip.height


def test_pictures_have_detail(clip: Clip) -> None:
    frame = clip.image(0).astype(float).mean(axis=2)
    steps = np.abs(np.diff(frame, axis=1))
    on_object = clip.mask(0)[:, 1:] == MASK_VALUES["object"]
    background = clip.mask(0)[:, 1:] == 0
    assert steps[on_object].mean() > 3 * steps[background].mean()
    assert 40 < frame.mean() < 220


def world_joints(clip: Clip, model: HandModel, side: Side) -> np.ndarray:
    """The loader's formula, x_world = MANO(...) + transl about the rest wrist; then into the camera."""
    track = clip.hands[side]
    betas = torch.as_tensor(track.betas, dtype=torch.float32)
    output = model(
        betas,
        model.pose_matrices(torch.as_tensor(track.hand_pose, dtype=torch.float32)),
        torch.as_tensor(Rotation.from_rotvec(track.global_orient).as_matrix(), dtype=torch.float32),
        model.rest_joints(betas)[0] + torch.as_tensor(track.transl, dtype=torch.float32),
    )
    joints = output.joints.numpy()
    return (
        np.einsum("tij,tnj->tni", clip.cam_from_world[:, :3, :3], joints)
        + clip.cam_from_world[:, None, :3, 3]
    )


def test_hands_err_as_regressors_do(
    clip: Clip, truth: dict[str, np.ndarray], hand_models: dict[Side, HandModel]
) -> None:
    for side in SIDES:
        joints, true = world_joints(clip, hand_models[side], side), truth[f"{side}_joints"]
        aligned = (joints - joints[:, :1]) - (true - true[:, :1])
        assert 0.0195 < np.linalg.norm(aligned, axis=-1).mean() < 0.0275
        apart = joints[:, 0] - true[:, 0]
        assert 0.025 < np.sqrt((apart[:, 2] ** 2).mean()) < 0.062
        pixels = [p @ clip.K.T for p in (joints[:, 0], true[:, 0])]
        drift = np.linalg.norm(np.diff([p[:, :2] / p[:, 2:] for p in pixels], axis=0)[0], axis=1)
        metres = drift / clip.K[0, 0] * true[:, 0, 2]
        assert metres.mean() < 0.03  # sideways it stays about right although the depth is wrong
        betas = np.abs(clip.hands[side].betas - truth[f"{side}_betas"])
        assert betas[0] == pytest.approx(0.9, abs=1e-4) and (betas[1:] > 0.3).all() and (betas < 1).all()
        assert 1 <= truth[f"{side}_init_dropped"].sum() <= 0.15 * len(clip)


def test_the_object_errs_as_structure_from_motion_does(clip: Clip, truth: dict[str, np.ndarray]) -> None:
    assert clip.object is not None and clip.object.colors is not None
    good = ~truth["pts_is_outlier"]
    assert 0.01 < 1 - good.mean() < 0.1
    assert 300 < len(good) < 2500
    error = float(truth["init_scale_error"])
    assert 0.05 <= abs(error) <= 0.10

    guess = clip.object.points_world() @ np.diag([1.0, -1.0, -1.0]) - clip.normalize_shift * [1, -1, -1]
    sfm = clip.object.metric_from_canon / np.array([[clip.object.scale]] * 3 + [[1.0]])
    points = clip.object.points @ sfm[:3, :3].T + sfm[:3, 3]
    on_object = truth["sfm_s"] * points @ truth["sfm_R"].T + truth["sfm_t"]
    true = np.einsum("tij,nj->tni", truth["obj_R"], on_object) + truth["obj_t"][:, None]
    mean_guess, mean_true = guess[:, good].mean(axis=1), true[:, good].mean(axis=1)
    np.testing.assert_allclose(mean_guess[:, 2] / mean_true[:, 2], 1 + error, atol=0.03)
    off = Rotation.from_matrix(
        (np.diag([1.0, -1.0, -1.0]) @ clip.object.rotations)
        @ np.swapaxes(truth["obj_R"] @ truth["sfm_R"], 1, 2)
    ).magnitude()
    assert 0.5 < np.rad2deg(np.median(off)) < 2.5


def test_points_lie_on_the_seen_surface(
    clip: Clip, truth: dict[str, np.ndarray], synthetic_clip: Path
) -> None:
    assert clip.object is not None and clip.object.colors is not None
    sfm = clip.object.metric_from_canon / np.array([[clip.object.scale]] * 3 + [[1.0]])
    points = (
        truth["sfm_s"] * (clip.object.points @ sfm[:3, :3].T + sfm[:3, 3]) @ truth["sfm_R"].T + truth["sfm_t"]
    )
    distance = np.abs(make_object("box").distance(points))
    good = ~truth["pts_is_outlier"]
    assert distance[good].max() < 0.006 and np.median(distance[good]) < 0.0015
    albedo = make_object("box").albedo(points[good])
    assert np.abs(albedo - clip.object.colors[good]).mean() < 0.15
    assert np.linalg.norm(clip.object.points, axis=1).max() == pytest.approx(1, abs=1e-6)


def test_the_object_turns_far_enough(truth: dict[str, np.ndarray]) -> None:
    steps = Rotation.from_matrix(truth["obj_R"][1:] @ np.swapaxes(truth["obj_R"][:-1], 1, 2)).magnitude()
    assert 180 < np.rad2deg(steps.sum()) < 270
    assert steps.max() < 3 * steps.mean()
    assert truth["obj_t"][:, 2].min() > 0.45 and truth["obj_t"][:, 2].max() < 0.75


def test_contact_is_real(synthetic_clip: Path, truth: dict[str, np.ndarray]) -> None:
    geometry = load_ground_truth(synthetic_clip)
    assert geometry.object_verts is not None
    for side in SIDES:
        assert truth[f"{side}_contact"].all()
        assert truth[f"{side}_min_dist"].min() > -0.003
        assert truth[f"{side}_tip_contact"].any(axis=0).sum() >= 3
        # The flags hold for the meshes as stored; vertices of the object are up to 2.5 mm apart.
        for t in (0, len(truth["obj_R"]) - 1):
            nearest, _ = cKDTree(geometry.object_verts[t]).query(geometry.verts[side][t])
            assert nearest.min() < 0.004


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_objects_and_grasps(kind: Any, hand_models: dict[Side, HandModel]) -> None:
    solid = make_object(kind)
    assert solid.mesh.is_watertight and solid.mesh.volume > 1e-4
    off = np.abs(solid.distance(solid.mesh.vertices))
    assert off.max() < 1e-3 and np.median(off) < 1e-5
    assert solid.albedo(solid.mesh.vertices).std(axis=0).min() > 0.1
    away = solid.distance(solid.mesh.vertices + 0.004 * solid.normals)
    assert np.median(np.abs(away - 0.004)) < 1e-4
    for side, model in hand_models.items():
        grasp = find_grasp(model, np.zeros(10), solid.places[side], solid.distance)
        verts, _ = pose_hand(
            model, np.zeros(10), grasp.fingers[None], grasp.rotation[None], grasp.wrist[None]
        )
        distance = solid.distance(verts[0])
        assert -0.003 < distance.min() < 0
        assert (distance < 0.003).sum() > 15


def test_a_function_of_the_seed(tmp_path: Path, hand_models: dict[Side, HandModel]) -> None:
    size = {"frames": 4, "width": 48, "height": 36, "object": "box", "hands": ("right",)}
    folders = [
        make_clip(tmp_path / name, hand_models=hand_models, seed=seed, **size)
        for name, seed in (("a", 1), ("b", 1), ("c", 2))
    ]
    files = [path.relative_to(folders[0]) for path in sorted(folders[0].rglob("*.*"))]
    assert len(files) == 4 + 4 + 4
    contents = [[(folder / file).read_bytes() for file in files] for folder in folders]
    assert contents[0] == contents[1]
    assert contents[0] != contents[2]


def test_one_hand(tmp_path: Path, hand_models: dict[Side, HandModel]) -> None:
    folder = make_clip(
        tmp_path, hand_models={"left": hand_models["left"]}, hands=("left",), frames=4, width=48, height=36
    )
    clip, truth = load_hold(folder), load_ground_truth(folder)
    assert set(clip.hands) == set(truth.verts) == {"left"}
    assert not clip.has_pixels("right").any() and clip.has_pixels("left").all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"object": "teapot"}, "object.*bottle, box, tool.*teapot"),
        ({"hands": ("right", "third")}, "hands.*third"),
        ({"frames": 2}, "4 frames.*2 of"),
        ({"width": 8}, "32 x 32.*8 x"),
    ],
)
def test_what_is_wrong(tmp_path: Path, hand_models: Any, change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        make_clip(tmp_path / "clip", hand_models=hand_models, **change)
    assert not (tmp_path / "clip").exists()


def test_missing_ray_caster(
    tmp_path: Path, hand_models: dict[Side, HandModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh.ray.ray_pyembree", None)
    with pytest.raises(InputError, match=r"pip install bigs\[synthetic\]"):
        make_clip(tmp_path / "clip", hand_models=hand_models, frames=4)
    assert not (tmp_path / "clip").exists()
