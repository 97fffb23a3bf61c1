"""Poses file: round trip, one hand, and files that are not right."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.export.poses import ClipPoses, HandPoses, ObjectPoses, load_poses, save_poses


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    hands = {
        side: HandPoses(
            global_orient=rng.normal(size=(4, 3)),
            hand_pose=rng.normal(size=(4, 15, 3)),
            transl=rng.normal(size=(4, 3)),
            betas=rng.normal(size=10),
            grasp=np.array([0, 0, -1, 1]),
            grasp_certainty=np.array([0.9, 0.8, 0.0, 0.7]),
        )
        for side in ("right", "left")
    }
    obj = ObjectPoses(Rotation.random(4, random_state=rng).as_matrix(), rng.normal(size=(4, 3)), 0.12)
    return ClipPoses(("a.jpg", "b.jpg", "c.jpg", "d.jpg"), np.diag([500.0, 500.0, 1.0]), hands, obj)


def test_round_trip(tmp_path, poses):
    save_poses(tmp_path / "poses.npz", poses)
    read = load_poses(tmp_path / "poses.npz")
    assert read.frame_names == poses.frame_names
    assert np.array_equal(read.K, poses.K)
    assert set(read.hands) == {"right", "left"}
    for side, hand in poses.hands.items():
        for written, found in zip(hand, read.hands[side], strict=True):
            assert np.array_equal(written, found)
    assert np.array_equal(read.object.rotations, poses.object.rotations)
    assert read.object.scale == 0.12


def test_the_file_holds_plain_arrays_only(tmp_path, poses):
    save_poses(tmp_path / "poses.npz", poses)
    with np.load(tmp_path / "poses.npz", allow_pickle=False) as stored:
        assert {"right_global_orient", "left_betas", "object_rotations", "K"} <= set(stored.files)
        assert stored["right_hand_pose"].shape == (4, 15, 3)
        assert all(stored[key].dtype != object for key in stored.files)


def test_what_is_missing_stays_missing(tmp_path, poses):
    alone = poses._replace(hands={"left": poses.hands["left"]}, object=None)
    save_poses(tmp_path / "poses.npz", alone)
    read = load_poses(tmp_path / "poses.npz")
    assert set(read.hands) == {"left"}
    assert read.object is None


def test_bad_values_are_named_and_nothing_is_written(tmp_path, poses):
    path = tmp_path / "poses.npz"
    hand = poses.hands["left"]
    for broken, message in (
        (hand._replace(transl=hand.transl[:3]), r"left_transl: expected shape \[4, 3\], found \[3, 3\]"),
        (hand._replace(betas=np.full(10, np.nan)), r"left_betas: expected finite values, found nan"),
    ):
        with pytest.raises(InputError, match=message):
            save_poses(path, poses._replace(hands={"left": broken}))
    with pytest.raises(InputError, match=r"object_scale: expected finite values, found inf"):
        save_poses(path, poses._replace(object=poses.object._replace(scale=np.inf)))
    assert list(tmp_path.iterdir()) == []


def test_wrong_files_are_named(tmp_path, poses):
    path = tmp_path / "poses.npz"
    with pytest.raises(InputError, match="found no such file"):
        load_poses(path)
    path.write_bytes(b"not a zip")
    with pytest.raises(InputError, match=r"poses\.npz: expected a poses file"):
        load_poses(path)
    np.savez(path, K=np.eye(3))
    with pytest.raises(InputError, match="expected format bigs-poses-2, found none"):
        load_poses(path)
    save_poses(path, poses)
    with np.load(path) as stored:
        arrays = {key: stored[key] for key in stored.files if key != "right_transl"}
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="expected a field right_transl"):
        load_poses(path)
    np.savez(path, **arrays, right_transl=np.array(["a"] * 12).reshape(4, 3))
    with pytest.raises(InputError, match="right_transl: expected numbers"):
        load_poses(path)
    np.savez(path, **arrays, right_transl=np.array([None] * 12).reshape(4, 3))
    with pytest.raises(InputError, match=r"poses\.npz: .right_transl.: expected an archive of plain arrays"):
        load_poses(path)
