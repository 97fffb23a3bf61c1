"""What other hand estimators leave becomes hands under the true camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from moving_hands import K, pose_track, two_hands
from scipy.spatial.transform import Rotation
from test_artefacts import FRAME_SET

from bigs.checks import InputError
from bigs.data.base import HandTrack
from bigs.hand import HandModel
from bigs.metrics.pose import mpjpe
from bigs.preprocess.artefacts import FrameSet
from bigs.preprocess.hands.dumps import full_image_translation, hamer_camera, read_hand_dump
from bigs.preprocess.hands.imported import import_hands
from bigs.preprocess.hands.tracks import HandEstimates
from bigs.types import SIDES, Side

T = 8
FRAMES: FrameSet = replace(
    FRAME_SET, names=tuple(f"{t:04d}.jpg" for t in range(T)), width=500, height=340, K=K
)
MISSING = 3
Models = dict[Side, HandModel]
Tracks = dict[Side, HandTrack]


@pytest.fixture(scope="module")
def tracks(both_hands: Models) -> Tracks:
    return two_hands(both_hands, T, 5)


def joints(models: Models, tracks: Tracks) -> dict[Side, np.ndarray]:
    return {side: pose_track(models[side], track) for side, track in tracks.items()}


def means(models: Models) -> dict[Side, np.ndarray]:
    return {side: model.hands_mean.double().numpy() for side, model in models.items()}


def read(file: Path, models: Models, frames: FrameSet = FRAMES) -> HandEstimates:
    return import_hands(read_hand_dump(file, frames, means(models)), frames.K, models)


def seen(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    pixels = points @ camera.T
    return pixels[..., :2] / pixels[..., 2:]


def assert_same_picture(found: np.ndarray, true: np.ndarray, assumed: np.ndarray, pixels: float) -> None:
    """Root-relative the same, the wrist seen where it was under the assumed camera, as large as it was.

    At the focal length that HaMeR assumes a pixel is a tenth of a millimetre here.
    """
    assert mpjpe(found, true).max() < 2.5
    assert np.abs(seen(found, K)[:, 0] - seen(true, assumed)[:, 0]).max() < pixels
    ratio = (K[0, 0] + K[1, 1]) / 2 / found[:, 0, 2] / (assumed[0, 0] / true[:, 0, 2])
    assert np.allclose(ratio, 1.0, atol=0.02)


def save_npy(file: Path, content: dict[str, Any]) -> Path:
    np.save(file, np.array(content, dtype=np.object_))
    return file


@pytest.mark.slow
@pytest.mark.parametrize("with_vertices", [False, True])
def test_hold_v3d(tmp_path: Path, both_hands: Models, tracks: Tracks, with_vertices: bool) -> None:
    assumed = hamer_camera(FRAMES.width, FRAMES.height)
    true = joints(both_hands, tracks)
    content: dict[str, Any] = {"K": assumed, "im_paths": [f"x/{name}" for name in FRAMES.names]}
    for side in SIDES:
        content[f"j3d.{side}"] = true[side].copy()
        content[f"j3d.{side}"][MISSING] = np.nan
        if with_vertices:
            content[f"v3d.{side}"] = posed_vertices(both_hands[side], tracks[side])
    found = read(save_npy(tmp_path / "v3d.npy", content), both_hands)
    for side in SIDES:
        track = found.tracks[side]
        assert np.flatnonzero(~track.valid).tolist() == [MISSING]
        placed = pose_track(both_hands[side], track)[track.valid]
        assert_same_picture(placed, true[side][track.valid], assumed, 6.0)
    # What is given as joints is fitted to a millimetre; skin makes it no worse.
    assert mpjpe(pose_track(both_hands["left"], found.tracks["left"]), true["left"])[0] < 1.5


def posed_vertices(model: HandModel, track: HandTrack) -> np.ndarray:
    from bigs.geometry.rotations import axis_angle_to_matrix

    orient, pose, betas, transl = (
        torch.as_tensor(a, dtype=torch.float32)
        for a in (track.global_orient, track.hand_pose, track.betas, track.transl)
    )
    with torch.no_grad():
        wrist = model.rest_joints(betas)[0] + transl
        return model(betas, model.pose_matrices(pose), axis_angle_to_matrix(orient), wrist).vertices.numpy()


def test_hold_fit(tmp_path: Path, both_hands: Models, tracks: Tracks) -> None:
    content: dict[str, Any] = {}
    for side, track in tracks.items():
        content[side] = {
            "global_orient": track.global_orient,
            "hand_pose": track.hand_pose.reshape(T, 45),
            "betas": np.tile(track.betas, (T, 1)),
            "transl": track.transl,
            "is_valid": np.array([t != MISSING for t in range(T)], dtype=np.float32),
        }
    found = read(save_npy(tmp_path / "hold_fit.slerp.npy", content), both_hands)
    true = joints(both_hands, tracks)
    for side in SIDES:
        track = found.tracks[side]
        assert np.flatnonzero(~track.valid).tolist() == [MISSING]
        placed = pose_track(both_hands[side], track)[track.valid]
        assumed = hamer_camera(FRAMES.width, FRAMES.height)
        assert_same_picture(placed, true[side][track.valid], assumed, 0.1)


def detections(models: Models, tracks: Tracks, *, crops: bool) -> dict[str, np.ndarray]:
    """What HaMeR says of every hand (mirrored crops), or WiLoR (placed and turned back already)."""
    rows: dict[str, list[Any]] = {}
    size = np.array([FRAMES.width, FRAMES.height])
    focal = hamer_camera(*size)[0, 0]
    for side, track in tracks.items():
        full = track.hand_pose + models[side].hands_mean.numpy()
        turns = np.concatenate([track.global_orient[:, None], full], axis=1)
        if crops and side == "left":
            turns = turns * [1.0, -1.0, -1.0]
        for t in range(T):
            if t == MISSING and side == "left":
                continue
            x, y, z = track.transl[t]
            box = 140.0 + 3 * t
            scale = 2 * focal / (box * z)
            center = size / 2 + focal * np.array([x, y]) / z + [4.0, -3.0]
            shift = np.array([x, y]) - 2 * (center - size / 2) / (box * scale)
            if side == "left":
                shift = shift * [-1.0, 1.0]
            row = {"frame": t, "right": side == "right", "betas": track.betas}
            row |= (
                {"pred_cam": [scale, *shift], "box_center": center, "box_size": box}
                if crops
                else {"pred_cam_t_full": track.transl[t]}
            )
            matrices = Rotation.from_rotvec(turns[t]).as_matrix()
            row |= {"global_orient": matrices[:1], "hand_pose": matrices[1:]} if crops else {
                "global_orient": turns[t, 0], "hand_pose": turns[t, 1:]
            }  # fmt: skip
            for key, value in row.items():
                rows.setdefault(key, []).append(value)
    return {key: np.array(values) for key, values in rows.items()}


@pytest.mark.parametrize("crops", [True, False])
def test_detections_of_hamer_and_wilor(
    tmp_path: Path, both_hands: Models, tracks: Tracks, crops: bool
) -> None:
    stored = detections(both_hands, tracks, crops=crops)
    assumed = hamer_camera(FRAMES.width, FRAMES.height)
    if not crops:
        stored["scaled_focal_length"] = np.array(assumed[0, 0])
    np.savez(tmp_path / "hands.npz", **stored)
    found = read(tmp_path / "hands.npz", both_hands)
    true = joints(both_hands, tracks)
    for side in SIDES:
        track = found.tracks[side]
        assert np.flatnonzero(~track.valid).tolist() == ([MISSING] if side == "left" else [])
        placed = pose_track(both_hands[side], track)[track.valid]
        assert_same_picture(placed, true[side][track.valid], assumed, 0.1)


def test_the_surest_of_two_detections_counts(tmp_path: Path, both_hands: Models, tracks: Tracks) -> None:
    stored = detections(both_hands, tracks, crops=False)
    rows = np.flatnonzero(stored["right"] & (stored["frame"] == 2))
    wrong = {key: values[rows].copy() for key, values in stored.items()}
    wrong["pred_cam_t_full"] = wrong["pred_cam_t_full"] + [0.3, 0.0, 0.0]
    both = {key: np.concatenate([wrong[key], values, wrong[key]]) for key, values in stored.items()}
    count = len(stored["right"])
    both["score"] = np.concatenate([[0.5], np.full(count, 0.9), [0.3]])
    both["scaled_focal_length"] = np.array(900.0)
    np.savez(tmp_path / "hands.npz", **both)
    dump = read_hand_dump(tmp_path / "hands.npz", FRAMES, means(both_hands))["right"]
    assert np.allclose(dump.transl, tracks["right"].transl)  # type: ignore[union-attr]


def test_a_hand_on_the_other_hands_place_is_dropped(
    tmp_path: Path, both_hands: Models, tracks: Tracks
) -> None:
    stored = detections(both_hands, tracks, crops=False)
    at = stored["frame"] == 5
    rests = {
        side: both_hands[side].rest_joints(torch.tensor(tracks[side].betas, dtype=torch.float32))[0]
        for side in SIDES
    }
    # Predicted with the wrong side, but about where the hand is seen: the wrist stays.
    apart = (rests["right"] - rests["left"]).numpy()
    stored["pred_cam_t_full"][at] += np.where(stored["right"][at][:, None], apart, -apart)
    stored["right"][at] = ~stored["right"][at]
    stored["scaled_focal_length"] = np.array(900.0)
    np.savez(tmp_path / "hands.npz", **stored)
    found = read(tmp_path / "hands.npz", both_hands)
    assert all(not found.tracks[side].valid[5] for side in SIDES)
    assert any("on the other hand's place in frame 5" in note for note in found.notes)


def test_hamers_formula_is_that_of_its_crop() -> None:
    """A point in a crop seen by the crop's own camera falls where the whole picture's camera sees it."""
    size, box, center = (640, 480), 200.0, np.array([[420.0, 130.0]])
    cam = np.array([[0.9, 0.03, -0.05]])
    whole = full_image_translation(cam, center, np.array([box]), *size)[0]
    # The crop's camera: 256 pixels, focal length 5000, at depth 2 * 5000 / (256 * scale).
    own = np.array([cam[0, 1], cam[0, 2], 2 * 5000 / (256 * cam[0, 0])])
    for offset in ([0.0, 0.0, 0.0], [0.05, -0.03, 0.0]):
        in_crop = 5000 * (own + offset)[:2] / (own + offset)[2] * box / 256
        in_whole = seen((whole + offset)[None], hamer_camera(*size))[0]
        assert np.allclose(center[0] + in_crop, in_whole, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"poses": np.zeros(3)}, "expected j3d.right"),
        ({"j3d.right": np.zeros((T, 20, 3))}, "j3d.right: expected shape [T, 21, 3]"),
        ({"j3d.right": np.full((T, 21, 3), np.nan)}, "expected a hand in at least one frame, found none"),
        ({"j3d.right": np.zeros((T + 1, 21, 3))}, "expected 8 (one for each frame)"),
        ({"right": {"global_orient": np.zeros((T, 3))}}, "right.transl: expected this field"),
        ({"right": np.ones(2), "global_orient": np.zeros((2, 5))}, "expected 1 rotation matrices"),
    ],
)
def test_other_files_are_refused(
    tmp_path: Path, both_hands: Models, content: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError) as caught:
        read(save_npy(tmp_path / "x.npy", content), both_hands)
    assert words in str(caught.value)


def test_a_missing_or_damaged_file(tmp_path: Path, both_hands: Models) -> None:
    (tmp_path / "x.npz").write_bytes(b"PK no")
    for name in ("x.npz", "none.npz"):
        with pytest.raises(InputError, match="expected"):
            read(tmp_path / name, both_hands)
