"""Every export of a real run, read back by programs and arithmetic that share nothing with the writer."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from command_line import Answer, Run, assert_refused
from glb_reader import Glb
from scipy.spatial.transform import Rotation

from bigs.commands.export.formats import Choice, write_format
from bigs.commands.folder.contents import load_run
from bigs.data.formats.hold import load_hold
from bigs.geometry.rotations import quat_to_matrix
from bigs.hand import HandModel
from bigs.models.playback import Playback
from bigs.types import SIDES, Gaussians, Side

pytestmark = pytest.mark.slow
# OpenCV's axes in those of glTF and SPZ.
F = np.diag([1.0, -1.0, -1.0])
FRAME = 3


@pytest.fixture(scope="module")
def playback(finished_run: Run) -> Playback:
    return load_run(finished_run.folder)


def covariances(quats_wxyz: np.ndarray, scales: np.ndarray) -> np.ndarray:
    axes = Rotation.from_quat(np.roll(quats_wxyz, -1, axis=1)).as_matrix() * scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def true_covariances(gaussians: Gaussians) -> np.ndarray:
    axes = (quat_to_matrix(gaussians.quats[0]) * gaussians.scales[:, None, :]).numpy().astype(float)
    return F @ (axes @ axes.transpose(0, 2, 1)) @ F


def test_splat_glb(playback: Playback, tmp_path: Path) -> None:
    (path,) = write_format(tmp_path, playback, "splat-glb", Choice(frames=(FRAME,)))
    assert path.name == "frame_0003.glb"
    glb = Glb(path)
    assert glb.json["extensionsUsed"] == ["KHR_gaussian_splatting"]
    for entity in playback.entities:
        (primitive,) = glb.json["meshes"][glb.json["nodes"][glb.node(entity)]["mesh"]]["primitives"]
        assert primitive["mode"] == 0
        shape = primitive["extensions"]["KHR_gaussian_splatting"]
        assert (shape["kernel"], shape["colorSpace"]) == ("ellipse", "srgb_rec709_display")
        read = {name.split(":")[-1]: value for name, value in glb.attributes(glb.node(entity)).items()}
        wanted = playback.gaussians([FRAME], [entity])
        np.testing.assert_allclose(read["POSITION"], wanted.means[0].numpy() @ F, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(read["ROTATION"], axis=1), 1.0, atol=1e-6)
        found = covariances(np.roll(read["ROTATION"], 1, axis=1), read["SCALE"])
        np.testing.assert_allclose(found, true_covariances(wanted), atol=1e-9)
        np.testing.assert_allclose(read["OPACITY"], wanted.opacities.numpy(), atol=1e-6)
        colors = 0.5 + 0.28209479 * read["SH_DEGREE_0_COEF_0"]
        np.testing.assert_allclose(colors, wanted.colors[0].clamp(0, 1).numpy(), atol=1e-5)
        assert read["COLOR_0"].shape == (len(colors), 4)
    # A reader that knows nothing of the extension shows the points.
    cloud = trimesh.load(path)
    points = np.concatenate([np.asarray(g.vertices) for g in cloud.geometry.values()])
    assert len(points) == playback.gaussians([0]).means.shape[1]


def test_spz(playback: Playback, tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="needs the extra 'export'")
    (path,) = write_format(tmp_path, playback, "spz", Choice(frames=(FRAME,)))
    read, wanted = gsply.read_spz(path), playback.gaussians([FRAME])
    np.testing.assert_allclose(read.means, wanted.means[0].numpy() @ F, atol=5e-6)
    np.testing.assert_allclose(np.exp(read.scales), wanted.scales.numpy(), rtol=0.04)
    np.testing.assert_allclose(1 / (1 + np.exp(-read.opacities)), wanted.opacities.numpy(), atol=0.01)
    colors = 0.5 + 0.28209479 * read.sh0
    np.testing.assert_allclose(colors, wanted.colors[0].clamp(0, 1).numpy(), atol=0.02)
    found, true = covariances(read.quats, np.exp(read.scales)), true_covariances(wanted)
    error = np.linalg.norm(found - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert error.max() < 0.1


def test_ply_at_frames(playback: Playback, tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="needs the extra 'export'")
    paths = write_format(tmp_path, playback, "ply", Choice(frames=(FRAME, 0)))
    assert [path.name for path in paths] == ["frame_0003.ply", "frame_0000.ply"]
    read, wanted = gsply.plyread(paths[0]), playback.gaussians([FRAME])
    np.testing.assert_allclose(read.means, wanted.means[0].numpy(), atol=1e-6)
    colors = 0.5 + 0.28209479 * read.sh0
    np.testing.assert_allclose(colors, wanted.colors[0].clamp(0, 1).numpy(), atol=1e-5)
    assert np.abs(gsply.plyread(paths[1]).means - read.means).max() > 1e-3


def test_animated_glb(playback: Playback, tmp_path: Path) -> None:
    (path,) = write_format(tmp_path, playback, "glb")
    glb, trajectory = Glb(path), playback.trajectory()
    np.testing.assert_allclose(glb.times(), np.arange(len(playback)) / 30.0, atol=1e-6)
    for side in SIDES:
        (skin,) = [s for s in glb.json["skins"] if s["joints"][0] == glb.node(f"{side} wrist")]
        assert len(skin["joints"]) == 16
        for frame in (0, FRAME, len(playback) - 1):
            joints = glb.matrices(frame)[skin["joints"], :3, 3] @ F
            np.testing.assert_allclose(joints, trajectory.joints[side][frame, :16], atol=1e-5)
            verts = glb.vertices(glb.node(f"{side} hand"), frame) @ F
            # Four bones a vertex; the model may have more.
            assert np.linalg.norm(verts - trajectory.verts[side][frame], axis=1).max() < 5e-4
    for frame in (0, FRAME):
        verts = glb.vertices(glb.node("object"), frame) @ F
        np.testing.assert_allclose(verts, trajectory.object_verts[frame], atol=1e-5)
    scene = trimesh.load(path)
    assert sorted(len(mesh.faces) for mesh in scene.geometry.values()) == sorted(
        [*(len(faces) for faces in trajectory.faces.values()), len(trajectory.object_faces)]
    )


def test_the_animated_hands_are_coloured_like_their_gaussians(playback: Playback, tmp_path: Path) -> None:
    (path,) = write_format(tmp_path, playback, "glb")
    glb = Glb(path)
    linear = glb.attributes(glb.node("right hand"))["COLOR_0"].mean(0)
    wanted = playback.hands["right"].splats.colors.mean(0).numpy() ** 2.2
    np.testing.assert_allclose(linear, wanted, atol=0.05)


@pytest.mark.parametrize("black", [0.0, 0.2])
def test_obj(playback: Playback, tmp_path: Path, black: float) -> None:
    playback = replace(playback, black=black)
    (path,) = write_format(tmp_path, playback, "obj")
    middle, trajectory = len(playback) // 2, playback.trajectory()
    assert path.name == f"frame_{middle:04d}.obj"
    lines = path.read_text().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o right", "o left", "o object"]
    wanted = [*(trajectory.verts[side][middle] for side in SIDES), trajectory.object_verts[middle]]
    read = trimesh.load(path, process=False, maintain_order=True)
    np.testing.assert_allclose(read.vertices, np.concatenate(wanted), atol=1e-6)
    assert len(read.faces) == sum(map(len, [*trajectory.faces.values(), trajectory.object_faces]))
    # Each vertex has the colours of Gaussians near it.
    colors = read.visual.vertex_colors[:, :3] / 255
    splats = playback.object.splats
    shown = colors[-len(playback.object.verts) :]
    distance = torch.cdist(playback.object.verts, splats.means)
    colored = black + splats.colors[distance.topk(4, largest=False).indices].mean(1)
    near = colored.clamp(0, 1).numpy()
    assert np.abs(shown - near).max() < 0.01 and shown.std(0).max() > 0.05
    skin = colors[: -len(playback.object.verts)]
    assert (skin[:, 0] > skin[:, 2] + 0.1).mean() > 0.9


def test_a_left_hand_is_coloured_as_the_mirrored_right_one(playback: Playback, tmp_path: Path) -> None:
    """Colours that tell places, on the canonical hand that both sides share."""
    places = playback.hands["right"].splats.points
    colors = (places - places.amin(0)) / (places.amax(0) - places.amin(0))
    hands = {
        side: replace(hand, splats=hand.splats._replace(points=places, colors=colors))
        for side, hand in playback.hands.items()
    }
    (path,) = write_format(tmp_path, replace(playback, hands=hands), "obj")
    shown = trimesh.load(path, process=False, maintain_order=True).visual.vertex_colors[:, :3] / 255
    count = hands["right"].verts.shape[1]
    right, left = shown[:count], shown[count : 2 * count]
    assert np.abs(right - left).mean() < 0.02 < 0.2 < right.std(0).max()


def test_rerun(playback: Playback, tiny_clip: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra 'rerun'")
    from rerun.chunk import RrdReader

    (path,) = write_format(tmp_path, playback, "rerun", Choice(clip=load_hold(tiny_clip)))
    read: dict[str, dict[int, dict[str, np.ndarray]]] = {}
    for chunk in RrdReader(path).stream():
        if "frame" in chunk.timeline_names:
            for row in chunk.to_record_batch().to_pylist():
                read.setdefault(chunk.entity_path, {}).setdefault(row["frame"], {}).update(row)
    trajectory = playback.trajectory()
    for entity in playback.entities:
        rows = read[f"/world/gaussians/{entity}"]
        assert sorted(rows) == list(range(len(playback)))
        wanted = playback.gaussians([FRAME], [entity])
        centers = rows[FRAME]["GaussianSplats3D:centers"]
        np.testing.assert_allclose(centers, wanted.means[0].numpy(), atol=1e-6)
        quats = np.roll(rows[FRAME]["GaussianSplats3D:quaternions"], 1, axis=1)
        found = covariances(quats, np.array(rows[FRAME]["GaussianSplats3D:scales"]))
        np.testing.assert_allclose(found, F @ true_covariances(wanted) @ F, atol=1e-9)
        verts = read[f"/world/meshes/{entity}"][FRAME]["Mesh3D:vertex_positions"]
        true = trajectory.object_verts if entity == "object" else trajectory.verts[entity]
        np.testing.assert_allclose(verts, true[FRAME], atol=1e-6)
    assert sorted(read["/world/camera"]) == list(range(len(playback)))


def mano(model: HandModel, orient: np.ndarray, fingers: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """MANO's forward pass for one frame, from its definition, axis-angle with the mean pose already added."""
    arrays = {name: value.double().numpy() for name, value in model.named_buffers()}
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    joints = arrays["J_regressor"] @ shaped
    turns = Rotation.from_rotvec(np.vstack([orient, fingers.reshape(15, 3)])).as_matrix()
    shaped = shaped + arrays["posedirs"] @ (turns[1:] - np.eye(3)).reshape(-1)
    world = np.zeros((16, 4, 4))
    for k, parent in enumerate(model.parents):
        local = np.eye(4)
        local[:3, :3] = turns[k]
        local[:3, 3] = joints[k] - (joints[parent] if k else 0.0)
        world[k] = world[parent] @ local if k else local
    world[:, :3, 3] -= np.einsum("kij,kj->ki", world[:, :3, :3], joints)
    verts = np.einsum("vk,kij,vj->vi", arrays["lbs_weights"], world[:, :3, :3], shaped)
    return verts + arrays["lbs_weights"] @ world[:, :3, 3]


@pytest.mark.parametrize("side", SIDES)
def test_mano_and_arctic(
    playback: Playback, both_hands: dict[Side, HandModel], tmp_path: Path, side: Side
) -> None:
    (first,) = write_format(tmp_path, playback, "mano")
    (second,) = write_format(tmp_path, playback, "arctic")
    m, a = np.load(first, allow_pickle=False), np.load(second, allow_pickle=False)
    model, wanted = both_hands[side], playback.hands[side].verts.numpy()
    mean = model.hands_mean.numpy().reshape(-1)
    for t in (0, FRAME):
        flat = mano(model, m[f"{side}_global_orient"][t], m[f"{side}_hand_pose_flat"][t], m[f"{side}_betas"])
        np.testing.assert_allclose(flat + m[f"{side}_transl"][t], wanted[t], atol=2e-5)
        curled = m[f"{side}_hand_pose"][t] + mean
        curled = mano(model, m[f"{side}_global_orient"][t], curled, m[f"{side}_betas"])
        np.testing.assert_allclose(curled + m[f"{side}_transl"][t], wanted[t], atol=2e-5)
        arctic = mano(model, a[f"{side}_rot"][t], a[f"{side}_pose"][t] + mean, a[f"{side}_shape"])
        np.testing.assert_allclose(arctic + a[f"{side}_trans"][t], wanted[t], atol=2e-5)
    np.testing.assert_allclose(m[f"{side}_joints"], playback.hands[side].joints.numpy())


def test_arctic_object(playback: Playback, tmp_path: Path) -> None:
    (path,) = write_format(tmp_path, playback, "arctic")
    stored = np.load(path, allow_pickle=False)
    row, verts = stored["object"][FRAME], playback.object.verts.numpy() * stored["object_scale"]
    placed = Rotation.from_rotvec(row[1:4]).apply(verts) + row[4:] / 1000.0
    np.testing.assert_allclose(placed, playback.trajectory().object_verts[FRAME], atol=1e-5)
    assert row[0] == 0.0


def test_the_command(call: Callable[..., Answer], finished_run: Run, tmp_path: Path) -> None:
    answer = call("export", finished_run.folder, "--format", "obj", "--out", tmp_path, "--frames", "1", "2")
    assert answer.code == 0
    assert answer.out.split() == [str(tmp_path / "meshes" / f"frame_000{t}.obj") for t in (1, 2)]
    everything = call("export", finished_run.folder, "--format", "ply", "--out", tmp_path, "--all-frames")
    assert everything.code == 0
    assert len(list((tmp_path / "gaussians").iterdir())) == 12


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--format obj --frames 12", ["frames", "0 to 11", "found 12"]),
        ("--format mano --frames 1", ["frames", "ply", "obj", "found mano"]),
        ("--format obj --frames 1 --all-frames", ["--all-frames", "found both"]),
        ("--format ply --clip somewhere", ["--clip", "rerun", "found ply"]),
    ],
)
def test_options_that_cannot_be(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path, options: str, words: list[str]
) -> None:
    assert_refused(call("export", finished_run.folder, "--out", tmp_path, *options.split()), *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("format", "module", "extra"), [("spz", "gsply", "export"), ("rerun", "rerun", "rerun")]
)
def test_a_missing_extra_is_named(
    call: Callable[..., Answer],
    monkeypatch: pytest.MonkeyPatch,
    finished_run: Run,
    tmp_path: Path,
    format: str,
    module: str,
    extra: str,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    answer = call("export", finished_run.folder, "--format", format, "--out", tmp_path)
    assert_refused(answer, f"extra '{extra}'")
