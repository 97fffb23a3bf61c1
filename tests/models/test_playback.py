"""A recorded scene shows what the scene showed, and survives its file bit for bit."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from small_scene import FRAMES, hand_model, make_scene

from bigs.checks import InputError
from bigs.models.playback import Playback, record
from bigs.models.playback_file import FORMAT, load_playback, save_playback
from bigs.types import HandObjectTrajectory

NAMES = tuple(f"{10 + i:04d}" for i in range(FRAMES))
SHIFT = (0.1, -0.2, 0.3)
CASES = {
    "both hands and object, lit": {"rich": True},
    "not shared, not lit": {"shared": False, "lighting": False},
    "left hand alone": {"sides": ("left",), "with_object": False},
    "object alone": {"sides": ()},
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES.keys())
def pair(request):
    """A scene and its recording."""
    scene = make_scene(**request.param)
    return scene, record(scene, "clip", NAMES, np.array(SHIFT))


def same(a, b) -> bool:
    return a is b or (a is not None and b is not None and torch.equal(a, b))


@torch.no_grad()
def test_a_recording_shows_what_the_scene_shows(pair) -> None:
    scene, playback = pair
    frames = torch.tensor([2, 0])
    canonical = scene.canonical(scene.entities)
    expected = {entity: scene.at(frames).posed({entity: canonical[entity]}) for entity in scene.entities}
    assert playback.entities == scene.entities and len(playback) == FRAMES
    for entity in scene.entities:
        for name, value in playback.gaussians([2, 0], [entity])._asdict().items():
            want = getattr(expected[entity], name)
            torch.testing.assert_close(value, want, atol=1e-6, rtol=1e-5, msg=f"{entity}: {name}")
    whole = playback.gaussians([2, 0])
    assert whole.means.shape[1] == sum(g.means.shape[1] for g in expected.values())


@torch.no_grad()
def test_a_recording_is_as_dark_and_as_pale_as_the_clip() -> None:
    scene = make_scene(rich=True)
    usual = record(scene, "clip", NAMES, SHIFT)
    scene.black, scene.brightness = 0.2, 0.3
    pale = record(scene, "clip", NAMES, SHIFT)
    shown = [(usual.gaussians([1]), pale.gaussians([1]))]
    shown += [(usual.canonical(entity), pale.canonical(entity)) for entity in scene.entities]
    for before, after in shown:
        torch.testing.assert_close(after.colors, 0.2 + 0.3 * before.colors)
        assert torch.equal(after.means, before.means) and torch.equal(after.opacities, before.opacities)


@torch.no_grad()
def test_the_trajectory_is_the_scenes_meshes(pair) -> None:
    scene, playback = pair
    trajectory = playback.trajectory()
    assert isinstance(trajectory, HandObjectTrajectory)
    assert (trajectory.name, trajectory.frame_names) == ("clip", NAMES)
    assert tuple(trajectory.verts) == tuple(trajectory.joints) == tuple(trajectory.faces) == scene.sides
    frames = torch.arange(FRAMES)
    for side in scene.sides:
        verts, joints = scene.at(frames).verts(side), scene.at(frames).joints(side)
        np.testing.assert_array_equal(trajectory.verts[side], verts.numpy())
        np.testing.assert_array_equal(trajectory.joints[side], joints.numpy())
        corners = trajectory.verts[side][0][trajectory.faces[side]]
        volume = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
        assert volume > 1e-5, "faces look inwards"
    if scene.object_splats is None:
        assert trajectory.object_verts is None and trajectory.object_faces is None
    else:
        np.testing.assert_allclose(
            trajectory.object_verts, scene.at(frames).object_points(scene.object_surface.verts), atol=1e-6
        )
        np.testing.assert_array_equal(trajectory.object_faces, scene.object_surface.faces)


def test_a_file_gives_back_every_bit(pair, tmp_path: Path) -> None:
    _, playback = pair
    path = tmp_path / "scene.safetensors"
    save_playback(path, playback)
    loaded = load_playback(path)
    for name in ("name", "frame_names", "width", "height", "normalize_shift", "entities", "shares_hand"):
        assert getattr(loaded, name) == getattr(playback, name), name
    assert torch.equal(loaded.K, playback.K) and same(loaded.light, playback.light)
    for a, b in zip(loaded.gaussians(range(FRAMES)), playback.gaussians(range(FRAMES)), strict=True):
        # What is stored is equal to the bit, below; what is worked out from it may round otherwise.
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
    one, other = loaded.trajectory(), playback.trajectory()
    for side in other.verts:
        np.testing.assert_allclose(one.verts[side], other.verts[side], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(one.joints[side], other.joints[side], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(one.faces[side], other.faces[side])
        hand, again = playback.hands[side], loaded.hands[side]
        for name, value in vars(hand).items():
            if name != "splats":
                assert torch.equal(value, getattr(again, name)), name
        for name, value in hand.splats._asdict().items():
            assert same(value, getattr(again.splats, name)), name
    if other.object_verts is not None:
        np.testing.assert_allclose(one.object_verts, other.object_verts, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(one.object_faces, other.object_faces)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@torch.no_grad()
def test_poses_are_in_each_sides_own_convention(pair) -> None:
    """x_cam = MANO(orient, pose, betas) + transl of the right model, or of its mirror image."""
    scene, playback = pair
    from bigs.geometry.rotations import axis_angle_to_matrix

    for side, hand in playback.hands.items():
        right = scene.hand_model(side)
        model = right if side == "right" else right.mirrored()
        out = model(
            hand.betas,
            model.pose_matrices(hand.hand_pose_aa),
            axis_angle_to_matrix(hand.global_orient_aa),
            model.rest_joints(hand.betas)[0] + hand.transl,
        )
        torch.testing.assert_close(out.vertices, hand.verts, atol=2e-6, rtol=0)
        torch.testing.assert_close(out.joints, hand.joints, atol=2e-6, rtol=0)
        rest = model.rest_vertices(hand.betas)
        if model.has_posedirs:
            rest = rest + model.corrective(model.pose_matrices(hand.hand_pose_aa))
        torch.testing.assert_close(hand.v_posed, rest, atol=2e-6, rtol=0)


def test_sharing_is_seen(pair) -> None:
    scene, playback = pair
    assert playback.shares_hand == (len(scene.hand_splats) < 2)


def test_canonical_gaussians_are_those_before_posing() -> None:
    scene = make_scene(rich=True)
    playback = record(scene, "clip", NAMES, SHIFT)
    with torch.no_grad():
        obj, hand = scene.object_splats(), scene.hand_splats["right"]()
        shaped = hand.points + hand.shapedirs @ scene.betas["right"]
    assert torch.equal(playback.canonical("object").means, obj.means)
    torch.testing.assert_close(playback.canonical("left").means, shaped)
    assert torch.equal(playback.canonical("right").quats, hand.quats)
    assert torch.equal(playback.canonical("right").colors, hand.colors)


def test_a_recording_needs_no_gradient_and_no_hand_model() -> None:
    playback = record(make_scene(rich=True), "clip", NAMES, SHIFT)
    assert not any(value.requires_grad for value in playback.gaussians([0]))
    assert playback.hands["right"].verts.shape[1] == len(hand_model().v_template)
    assert playback.normalize_shift == SHIFT


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "scene.safetensors"
    save_playback(path, record(make_scene(sides=("right",)), "clip", NAMES, SHIFT))
    return path.read_bytes()


@pytest.mark.parametrize("keep", [0, 5, 300, -1])
def test_a_cut_off_file_is_an_input_error(tmp_path: Path, saved: bytes, keep: int) -> None:
    path = tmp_path / "scene.safetensors"
    path.write_bytes(saved[:keep])
    with pytest.raises(InputError, match="damaged") as raised:
        load_playback(path)
    assert str(path) in str(raised.value)


def test_a_file_of_something_else_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(InputError, match=f"expected format {FORMAT}, found None"):
        load_playback(path)
    save_file({"x": torch.zeros(2)}, path, {"bigs": json.dumps({"format": "bigs-scene-999"})})
    with pytest.raises(InputError, match="bigs-scene-999"):
        load_playback(path)
    path.write_bytes(b"\x00" * 100)
    with pytest.raises(InputError, match="damaged"):
        load_playback(path)


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(InputError, match=r"no such file|a folder"):
            load_playback(path)


def test_a_failed_save_leaves_the_old_file(tmp_path: Path, saved: bytes, monkeypatch) -> None:
    path = tmp_path / "scene.safetensors"
    path.write_bytes(saved)

    def fail(*arguments) -> bytes:
        raise MemoryError

    monkeypatch.setattr("bigs.models.playback_file.save", fail)
    playback = load_playback(path)
    assert isinstance(playback, Playback)
    with pytest.raises(MemoryError):
        save_playback(path, playback)
    assert path.read_bytes() == saved and len(list(tmp_path.iterdir())) == 1
