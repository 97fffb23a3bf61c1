"""Ground truth in each data set's layout, written from one clip, is the same truth to a micrometre."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from mano_twin import odd_models, pose_mano
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.commands.clips.truth import load_truth, pose_annotation
from bigs.data.base import Clip
from bigs.data.formats.annotation import Annotation
from bigs.data.formats.arctic import find_arctic, read_arctic
from bigs.data.formats.ho3d import CV_FROM_GL
from bigs.data.formats.writers import write_arctic, write_ho3d
from bigs.data.ground_truth import load_annotation
from bigs.data.moving import in_world
from bigs.hand import HandModel, load_hand_models
from bigs.types import SIDES, HandObjectTrajectory, Side
from bigs.unpickle import load_npy, restricted_load

MICROMETRE = 1e-6


@pytest.fixture(scope="module")
def models(both_hands: dict[Side, HandModel]) -> dict[Side, HandModel]:
    return odd_models(both_hands)


@pytest.fixture(scope="module")
def annotation(tiny_clip: Path) -> Annotation:
    return load_annotation(tiny_clip)


def wrists(annotation: Annotation, models: dict[Side, HandModel]) -> dict[Side, np.ndarray]:
    return {
        side: models[side].rest_joints(torch.as_tensor(track.betas, dtype=torch.float32))[0].double().numpy()
        for side, track in annotation.hands.items()
    }


def some_world() -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    motion[:3, 3] = [0.3, -1.2, 0.9]
    return motion


def assert_same(found: HandObjectTrajectory, expected: HandObjectTrajectory) -> None:
    for side in expected.joints:
        np.testing.assert_allclose(found.joints[side], expected.joints[side], atol=MICROMETRE)
        np.testing.assert_allclose(found.verts[side], expected.verts[side], atol=MICROMETRE)
        np.testing.assert_array_equal(found.faces[side], expected.faces[side])
    np.testing.assert_allclose(found.object_verts, expected.object_verts, atol=MICROMETRE)
    np.testing.assert_array_equal(found.object_faces, expected.object_faces)


def test_the_poses_of_a_clips_truth_are_its_meshes(
    tiny_clip: Path, annotation: Annotation, both_hands: dict[Side, HandModel]
) -> None:
    assert_same(pose_annotation(annotation, both_hands), load_truth(tiny_clip, (), {}))


def test_arctic_holds_the_same_truth(
    tmp_path: Path, tiny: Clip, annotation: Annotation, models: dict[Side, HandModel]
) -> None:
    expected = pose_annotation(annotation, models)
    written = write_arctic(
        tmp_path,
        in_world(annotation, some_world(), wrists(annotation, models)),
        subject="s07",
        sequence="bottle_grab_02",
        images=[tiny.image(t) for t in range(len(tiny))],
        view=3,
        offset=250,
    )
    assert written == tmp_path / "images" / "s07" / "bottle_grab_02" / "3"
    names = [f"{250 + t:05d}.jpg" for t in range(len(tiny))]
    found = load_truth(written, names, models)
    assert found.name == "arctic_s07_bottle_grab_02_3" and list(found.frame_names) == names
    assert_same(found, expected)
    # Millimetres and the mean pose stand in the files as the data set has them.
    stored = np.load(tmp_path / "raw_seqs" / "s07" / "bottle_grab_02.object.npy")
    assert stored.shape == (len(tiny), 7) and 100 < np.abs(stored[:, 4:]).max() < 5000
    hands = load_npy(tmp_path / "raw_seqs" / "s07" / "bottle_grab_02.mano.npy")
    np.testing.assert_array_equal(
        hands["left"]["pose"], annotation.hands["left"].hand_pose.reshape(len(tiny), 45)
    )


def test_arctic_poses_mean_what_its_hand_layer_makes_of_them(
    tmp_path: Path, annotation: Annotation, models: dict[Side, HandModel]
) -> None:
    """Relative to the mean pose, each side by its own model, no sign corrected, then the camera."""
    world = in_world(annotation, some_world(), wrists(annotation, models))
    images = np.zeros((len(world), world.height, world.width, 3), dtype=np.uint8)
    folder = write_arctic(tmp_path, world, subject="s01", sequence="box_use_01", images=images)
    found = load_truth(folder, ["00104.jpg"], models)
    hands = load_npy(tmp_path / "raw_seqs" / "s01" / "box_use_01.mano.npy")
    for side, model in models.items():
        one = hands[side]
        absolute = one["pose"][4].reshape(15, 3) + model.hands_mean.double().numpy()
        verts, joints = pose_mano(model, one["rot"][4], absolute, one["trans"][4], one["shape"])
        to_cam = world.cam_from_world[4]
        for mine, twin in ((found.verts, verts), (found.joints, joints)):
            np.testing.assert_allclose(
                mine[side][0], twin @ to_cam[:3, :3].T + to_cam[:3, 3], atol=MICROMETRE
            )


def test_ho3d_holds_the_same_truth(
    tmp_path: Path, tiny: Clip, annotation: Annotation, models: dict[Side, HandModel]
) -> None:
    mean = models["right"].hands_mean.double().numpy()
    folder = write_ho3d(
        tmp_path,
        in_world(annotation, CV_FROM_GL, wrists(annotation, models)),
        clip="SM7",
        object_name="006_mustard_bottle",
        images=[tiny.image(t) for t in range(len(tiny))],
        hands_mean=mean,
    )
    names = [f"{t:04d}.jpg" for t in range(len(tiny))]
    expected = pose_annotation(annotation, models)
    found = load_truth(folder, names, models)
    assert found.name == "hold_SM7_ho3d" and set(found.joints) == {"right"}
    np.testing.assert_allclose(found.joints["right"], expected.joints["right"], atol=MICROMETRE)
    np.testing.assert_allclose(found.verts["right"], expected.verts["right"], atol=MICROMETRE)
    np.testing.assert_allclose(found.object_verts, expected.object_verts, atol=MICROMETRE)
    # The file's own hand: absolute poses, and the world upside down.
    with (folder / "meta" / "0005.pkl").open("rb") as file:
        one = restricted_load(file, name="0005.pkl")
    verts, _ = pose_mano(
        models["right"],
        one["handPose"][:3],
        one["handPose"][3:].reshape(15, 3),
        one["handTrans"],
        one["handBeta"],
    )
    np.testing.assert_allclose(found.verts["right"][5], verts * [1, -1, -1], atol=MICROMETRE)


def test_frames_without_annotation_have_no_truth(
    tmp_path: Path, tiny: Clip, annotation: Annotation, models: dict[Side, HandModel]
) -> None:
    images = [tiny.image(t) for t in range(len(tiny))]
    rest = wrists(annotation, models)
    folder = write_arctic(tmp_path, annotation, subject="s01", sequence="box_grab_01", images=images)
    names = ["00099.jpg", "00100.jpg", "00111.jpg", "00112.jpg"]
    found = load_truth(folder, names, models)
    for values in (*found.joints.values(), *found.verts.values(), found.object_verts):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=(1, 2)), [False, True, True, False])

    upside_down = in_world(annotation, CV_FROM_GL, rest)
    assert upside_down.object is not None
    upside_down.object.valid[3] = False
    folder = write_ho3d(
        tmp_path / "ho3d",
        upside_down,
        clip="AB1",
        object_name="box",
        images=images,
        hands_mean=np.zeros((15, 3)),
    )
    found = load_truth(folder, ["0002.jpg", "0003.jpg"], models)
    np.testing.assert_array_equal(np.isfinite(found.joints["right"]).all(axis=(1, 2)), [True, False])


def test_a_lid_turns_with_its_part(tmp_path: Path, annotation: Annotation) -> None:
    images = np.zeros((len(annotation), annotation.height, annotation.width, 3), dtype=np.uint8)
    folder = write_arctic(tmp_path, annotation, subject="s01", sequence="box_use_01", images=images)
    file = tmp_path / "raw_seqs" / "s01" / "box_use_01.object.npy"
    poses = np.load(file)
    poses[:, 0] = np.linspace(0, 1.2, len(poses))
    np.save(file, poses)
    template = tmp_path / "meta" / "object_vtemplates" / "box"
    assert annotation.object is not None
    verts = annotation.object.verts
    upper = verts[:, 1] > 0
    view = find_arctic(folder)
    assert view is not None
    names = [f"{100 + t:05d}.jpg" for t in range(len(annotation))]
    turned = verts @ Rotation.from_rotvec([0, 0, -poses[-1, 0]]).as_matrix().T

    def bent() -> np.ndarray:
        truth = read_arctic(view, names).object
        assert truth is not None
        np.testing.assert_allclose(truth.verts[0], verts, atol=MICROMETRE)
        return truth.verts[-1]

    (template / "parts.json").write_text(str([0 if up else 1 for up in upper]))
    np.testing.assert_allclose(bent(), np.where(upper[:, None], turned, verts), atol=MICROMETRE)
    # Where the boxes of the parts are known they decide which number is the lid.
    corners = {
        f"bbox_{name}": (1000 * np.repeat([verts[part].mean(axis=0)], 8, axis=0)).tolist()
        for name, part in (("top", ~upper), ("bottom", upper))
    }
    (template / "object_params.json").write_text(str(corners).replace("'", '"'))
    np.testing.assert_allclose(bent(), np.where(upper[:, None], verts, turned), atol=MICROMETRE)


def test_a_template_in_metres_is_the_same_object(tmp_path: Path, annotation: Annotation) -> None:
    images = np.zeros((len(annotation), annotation.height, annotation.width, 3), dtype=np.uint8)
    folder = write_arctic(tmp_path, annotation, subject="s01", sequence="box_use_01", images=images)
    view = find_arctic(folder)
    assert view is not None
    millimetres = read_arctic(view, ["00100.jpg"]).object
    file = tmp_path / "meta" / "object_vtemplates" / "box" / "mesh.obj"
    lines = [
        "v " + " ".join(str(float(x) / 1000) for x in line.split()[1:4]) if line.startswith("v ") else line
        for line in file.read_text().splitlines()
    ]
    file.write_text("\n".join(lines))
    metres = read_arctic(view, ["00100.jpg"]).object
    assert millimetres is not None and metres is not None
    assert np.ptp(metres.verts, axis=0).max() < 0.5
    np.testing.assert_allclose(metres.verts, millimetres.verts, atol=MICROMETRE)


def test_the_egocentric_camera_moves(tmp_path: Path, annotation: Annotation) -> None:
    images = np.zeros((len(annotation), annotation.height, annotation.width, 3), dtype=np.uint8)
    write_arctic(tmp_path, annotation, subject="s01", sequence="box_use_01", images=images)
    frames = len(annotation)
    rotations = Rotation.random(frames, random_state=2).as_matrix()
    offsets = np.random.default_rng(2).normal(size=(frames, 3, 1))
    camera = {"R_k_cam_np": rotations, "T_k_cam_np": offsets, "intrinsics": np.diag([500.0, 500.0, 1.0])}
    file = tmp_path / "raw_seqs" / "s01" / "box_use_01.egocam.dist.npy"
    np.save(file, np.array(camera | {"dist8": np.zeros(8)}, dtype=np.object_))
    view = find_arctic(tmp_path / "s01" / "box_use_01" / "0")
    assert view is not None
    found = read_arctic(view, ["00107.jpg"])
    np.testing.assert_array_equal(found.cam_from_world[0, :3], np.hstack([rotations[7], offsets[7]]))
    assert found.K[0, 0] == 500
    # A lens bends pictures, not the truth.
    np.save(file, np.array(camera | {"dist8": np.full(8, 0.1)}, dtype=np.object_))
    bent = read_arctic(view, ["00107.jpg"])
    np.testing.assert_array_equal(bent.cam_from_world, found.cam_from_world)
    np.testing.assert_array_equal(bent.hands["right"].transl, found.hands["right"].transl)


def test_the_raw_style_copy_of_a_clip_is_its_truth() -> None:
    clips, hands = os.environ.get("BIGS_CLIPS"), os.environ.get("BIGS_HAND_MODEL")
    if not clips or not hands:
        pytest.skip("BIGS_CLIPS or BIGS_HAND_MODEL is not set")
    expected = load_truth(Path(clips) / "dev_mustard", (), {})
    found = load_truth(Path(clips) / "arctic_raw_style", expected.frame_names, load_hand_models(Path(hands)))
    assert_same(found, expected)


def test_an_excerpts_truth_is_that_of_its_frames(tiny_clip: Path, models: dict[Side, HandModel]) -> None:
    whole = load_truth(tiny_clip, [], models)
    some = load_truth(tiny_clip, ["00007.jpg", "elsewhere/00002.png"], models)
    assert some.frame_names == (whole.frame_names[2], whole.frame_names[7])
    for side in SIDES:
        np.testing.assert_array_equal(some.joints[side], whole.joints[side][[2, 7]])
        np.testing.assert_array_equal(some.verts[side], whole.verts[side][[2, 7]])
    assert some.object_verts is not None and whole.object_verts is not None
    np.testing.assert_array_equal(some.object_verts, whole.object_verts[[2, 7]])
    # Of another clip: what does not fit is for the scores to say.
    assert load_truth(tiny_clip, ["00007.jpg", "00099.jpg"], models).frame_names == whole.frame_names


def test_no_truth_there(tmp_path: Path, models: dict[Side, HandModel]) -> None:
    with pytest.raises(InputError, match=r"expected gt.npz, .* found another folder"):
        load_truth(tmp_path, ("a.png",), models)
    with pytest.raises(InputError, match="found nothing"):
        load_truth(tmp_path / "absent", ("a.png",), models)
