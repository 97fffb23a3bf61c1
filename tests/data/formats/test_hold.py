"""The `build` folder: what is written is read back, and real clips land where their ground truth says."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp
from small_clip import FRAMES, HEIGHT, SHIFT, WIDTH, K, random_hand, random_object, small_masks

from bigs.data.base import Clip
from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_ground_truth
from bigs.data.synthetic.raycast import Body, take_picture
from bigs.hand import load_hand_models
from bigs.types import MASK_VALUES
from bigs.unpickle import load_npy


@pytest.mark.parametrize("torch_norm_mat", [True, False])
def test_what_is_written_is_read_back(write_small: Callable[..., Path], torch_norm_mat: bool) -> None:
    rng = np.random.default_rng(3)
    hands, obj = {"right": random_hand(rng), "left": random_hand(rng)}, random_object(rng)
    folder = write_small(hands=hands, object=obj, torch_norm_mat=torch_norm_mat)
    stored = load_npy(folder / "build" / "data.npy")["entities"]["object"]["norm_mat"]
    assert isinstance(stored, torch.Tensor if torch_norm_mat else np.ndarray)

    clip = load_hold(folder)
    assert (clip.name, len(clip), clip.width, clip.height) == ("small", FRAMES, WIDTH, HEIGHT)
    assert clip.frame_names[0] == "00100.jpg"
    np.testing.assert_allclose(clip.K, K, atol=1e-9)
    expected = np.eye(4)
    expected[:3, :3] = np.diag([1.0, -1.0, -1.0])
    expected[:3, 3] = -np.diag([1.0, -1.0, -1.0]) @ SHIFT
    np.testing.assert_allclose(clip.cam_from_world, np.broadcast_to(expected, (FRAMES, 4, 4)), atol=1e-12)
    assert clip.scene_scale == pytest.approx(2 / np.linalg.norm(SHIFT))
    for side, track in hands.items():
        for field in ("global_orient", "hand_pose", "transl", "betas", "valid"):
            np.testing.assert_allclose(getattr(clip.hands[side], field), getattr(track, field), atol=1e-6)
    for field in ("points", "colors", "scale", "metric_from_canon", "rotations", "transl", "valid"):
        np.testing.assert_allclose(getattr(clip.object, field), getattr(obj, field), atol=1e-6)


def test_frames_a_second(
    write_small: Callable[..., Path], edit_data: Callable[[Callable[[dict[str, Any]], None]], Path]
) -> None:
    assert load_hold(write_small(fps=12.5)).fps == 12.5
    # HOLD's own files do not say, but number the frames of a video.
    folder = edit_data(lambda data: data.pop("fps"))
    assert load_hold(folder).fps == 30.0
    (folder / "build" / "corres.txt").write_text("".join(f"{5 * t:05d}.jpg\n" for t in range(FRAMES)))
    assert load_hold(folder).fps == 6.0


def test_images_and_masks_keep_their_order(write_small: Callable[..., Path]) -> None:
    images = np.random.default_rng(0).integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    clip = load_hold(write_small(images=images))
    for t, mask in enumerate(small_masks()):
        np.testing.assert_array_equal(clip.image(t), images[t])
        np.testing.assert_array_equal(clip.mask(t), mask)
    np.testing.assert_array_equal(clip.has_pixels("left"), [True, True, False, True, True])
    assert clip.has_pixels("right").all()


def test_the_build_folder_itself_is_a_clip(write_small: Callable[..., Path]) -> None:
    folder = write_small()
    assert load_hold(folder / "build").name == load_hold(folder).name


@pytest.mark.parametrize("missing", ["left", "right", "object"])
def test_an_entity_may_be_missing(edit_data: Callable[..., Path], missing: str) -> None:
    clip = load_hold(edit_data(lambda data: data["entities"].pop(missing)))
    assert (clip.object is None) == (missing == "object")
    assert set(clip.hands) == {"right", "left"} - {missing}


def test_colours_and_names_may_be_missing(edit_data: Callable[..., Path]) -> None:
    folder = edit_data(lambda data: data["entities"]["object"].pop("pts.rgb"))
    (folder / "build" / "corres.txt").unlink()
    clip = load_hold(folder)
    assert clip.object is not None and clip.object.colors is None
    assert clip.frame_names == tuple(f"{t:04d}.png" for t in range(FRAMES))


def test_invalid_frames_are_filled_on_the_arc(edit_data: Callable[..., Path]) -> None:
    def spoil(data: dict[str, Any]) -> None:
        for entity, keys in (("right", ("hand_poses", "hand_trans")), ("object", ("object_poses",))):
            data["entities"][entity]["is_valid"] = np.array([0, 1, 0, 1, 1])
            for key in keys:
                data["entities"][entity][key][[0, 2]] = np.nan

    clip = load_hold(edit_data(spoil))
    hand, obj = clip.hands["right"], clip.object
    assert obj is not None
    np.testing.assert_array_equal(hand.valid, [False, True, False, True, True])
    np.testing.assert_allclose(hand.global_orient[0], hand.global_orient[1], atol=1e-12)
    np.testing.assert_allclose(hand.transl[2], (hand.transl[1] + hand.transl[3]) / 2)
    middle = Slerp([1, 3], Rotation.from_rotvec(hand.hand_pose[[1, 3], 6]))(2)
    assert (middle.inv() * Rotation.from_rotvec(hand.hand_pose[2, 6])).magnitude() < 1e-6
    middle = Slerp([1, 3], Rotation.from_matrix(obj.rotations[[1, 3]]))(2)
    assert (middle.inv() * Rotation.from_matrix(obj.rotations[2])).magnitude() < 1e-6
    assert clip.hands["left"].valid.all()


def test_a_camera_known_up_to_scale_is_read(edit_data: Callable[..., Path]) -> None:
    def scale_up(data: dict[str, Any]) -> None:
        for t in range(FRAMES):
            data["cameras"][f"world_mat_{t}"][:3] *= 2.5

    np.testing.assert_allclose(load_hold(edit_data(scale_up)).K, K, atol=1e-4)


# ---- clips with ground truth ------------------------------------------------------------------------------


def project(clip: Clip, points_cam: np.ndarray) -> np.ndarray:
    """Column and row indices [N, 2] of the pixels that hold points [N, 3]: pixel i covers [i, i + 1)."""
    pixels = points_cam @ clip.K.T
    return np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int)


def to_camera(clip: Clip, points_world: np.ndarray, t: int) -> np.ndarray:
    return points_world @ clip.cam_from_world[t, :3, :3].T + clip.cam_from_world[t, :3, 3]


def test_true_geometry_lands_in_the_masks(shared_clip: Path) -> None:
    """K and pixel centres: rays through (i + 0.5, j + 0.5) see what the masks say, others do not."""
    clip, truth = load_hold(shared_clip), load_ground_truth(shared_clip)
    assert truth.object_verts is not None and truth.object_faces is not None
    black = np.zeros((clip.height, clip.width, 3))
    half_off = clip.K - 0.5 * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    for t in (0, len(clip) // 2):
        meshes = [(side, truth.verts[side][t], truth.faces[side]) for side in truth.verts]
        meshes.append(("object", truth.object_verts[t], truth.object_faces))
        bodies = [
            Body(MASK_VALUES[entity], verts, faces, verts, verts, np.zeros_like)
            for entity, verts, faces in meshes
        ]
        # A sleeve hides parts of the scene and counts as background.
        shown = clip.mask(t) > 0
        assert (take_picture(bodies, clip.K, black).mask != clip.mask(t))[shown].mean() < 1e-3
        assert (take_picture(bodies, half_off, black).mask != clip.mask(t))[shown].mean() > 5e-3


def test_initial_object_points_land_near_the_true_ones(shared_clip: Path) -> None:
    clip, truth = load_hold(shared_clip), np.load(shared_clip / "gt.npz")
    assert clip.object is not None
    good = ~truth["pts_is_outlier"]
    # The file's own formula, with the true similarity in place of the estimated pose.
    canon_to_sfm = clip.object.metric_from_canon / np.array([[clip.object.scale]] * 3 + [[1.0]])
    reconstructed = clip.object.points @ canon_to_sfm[:3, :3].T + canon_to_sfm[:3, 3]
    true_points = truth["sfm_s"] * reconstructed @ truth["sfm_R"].T + truth["sfm_t"]
    guessed = clip.object.points_world()
    for t in range(0, len(clip), 20):
        truly_cam = true_points @ truth["obj_R"][t].T + truth["obj_t"][t]
        guess_cam = to_camera(clip, guessed[t], t)
        a, b = project(clip, truly_cam[good]), project(clip, guess_cam[good])
        assert np.median(np.abs(a - b)) < 12  # 4 mm of jitter at 0.7 m is 6 pixels
        ratio = np.median(guess_cam[good, 2] / truly_cam[good, 2])
        assert abs(abs(ratio - 1) - abs(truth["init_scale_error"])) < 0.02


def test_initial_hands_land_near_the_true_ones(shared_clip: Path) -> None:
    folder = os.environ.get("BIGS_HAND_MODEL")
    if not folder:
        pytest.skip("BIGS_HAND_MODEL is not set")
    clip, truth = load_hold(shared_clip), np.load(shared_clip / "gt.npz")
    for side, model in load_hand_models(folder).items():
        track = clip.hands[side]
        betas = torch.as_tensor(track.betas, dtype=torch.float32)
        pose = model.pose_matrices(torch.as_tensor(track.hand_pose, dtype=torch.float32))
        wrist_rotation = Rotation.from_rotvec(track.global_orient).as_matrix()
        # x_world = MANO(...) + transl, where MANO turns about its rest wrist joint.
        wrist = model.rest_joints(betas)[0].numpy() + track.transl
        joints = model(
            betas, pose, *(torch.as_tensor(a, dtype=torch.float32) for a in (wrist_rotation, wrist))
        )
        joints_cam = np.stack([to_camera(clip, joints.joints[t].numpy(), t) for t in range(len(clip))])
        true = truth[f"{side}_joints"]
        aligned = (joints_cam - joints_cam[:, :1]) - (true - true[:, :1])
        assert 0.018 < np.linalg.norm(aligned, axis=-1).mean() < 0.029
        apart = joints_cam[:, 0] - true[:, 0]
        assert np.abs(apart[:, :2]).mean() < 0.03 and np.abs(apart[:, 2]).mean() < 0.08
