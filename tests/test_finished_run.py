"""The product: a clip goes in, a run folder comes out; readers that share no code with it read it back."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from command_line import Answer, Run
from PIL import Image
from ply_reader import positions, read_ply
from safetensors import safe_open
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.train.plan.config import CompletionStage, GuidanceStage, OptimizeStage
from bigs.train.plan.presets import PRESETS
from bigs.types import ENTITIES, Side

pytestmark = pytest.mark.slow

# The stages of a run without a diffusion prior.
UNGUIDED = [
    stage for stage in PRESETS["smoke"].stages if not isinstance(stage, CompletionStage | GuidanceStage)
]


@pytest.fixture(scope="module")
def scene(finished_run: Run) -> dict[str, np.ndarray]:
    return load_file(finished_run.folder / "scene.safetensors")


def test_it_ends_well(finished_run: Run) -> None:
    assert finished_run.answer.code == 0, finished_run.answer.err
    assert "MPJPE" in finished_run.answer.out and "F10" in finished_run.answer.out
    assert f"results in {finished_run.folder}" in finished_run.answer.out
    assert "Traceback" not in finished_run.answer.err


def test_every_file_is_there_and_none_is_left_over(finished_run: Run, tiny: Clip) -> None:
    found = {str(p.relative_to(finished_run.folder)) for p in finished_run.folder.rglob("*") if p.is_file()}
    assert found == {
        "config.yaml",
        "log.jsonl",
        "checkpoints/latest.safetensors",
        "scene.safetensors",
        "gaussians/hand.ply",
        "gaussians/object.ply",
        "poses.npz",
        "meshes/object.ply",
        f"arctic_preds/{tiny.name}.pt",
        "metrics.json",
        "preview.png",
        "preview.mp4",
        "report.html",
    }


def test_the_scores_are_better_than_the_estimates(finished_run: Run) -> None:
    scores = json.loads((finished_run.folder / "metrics.json").read_text())
    initial, result = scores["initial"], scores["result"]
    assert set(initial) <= set(result)
    assert all(math.isfinite(value) for row in scores.values() for value in row.values())
    for key in ("mpjpe_ra_r", "mpjpe_ra_l", "wrist_h", "cd_r_sq", "cd_l_sq", "cd_icp_sq"):
        assert result[key] < initial[key], key
    assert result["f10_icp"] > initial["f10_icp"]
    assert 15 < result["psnr_foreground"] < 60
    assert 0.5 < result["ssim_foreground"] < 1


def test_the_configuration_can_be_run_again(finished_run: Run, tiny_clip: Path) -> None:
    written = yaml.safe_load((finished_run.folder / "config.yaml").read_text())
    assert written["clip"] == str(tiny_clip.resolve())
    assert written["hand_model"] is None
    assert {"bigs", "torch"} <= written.keys()
    stages = written["config"]["stages"]
    assert list(stages) == [stage.name for stage in UNGUIDED], "without the prior's, which is off"
    assert stages["joint"]["steps"] == 12
    assert stages["joint"]["lrs"]["hand.ray"] > 0


def test_the_log_has_every_step(finished_run: Run) -> None:
    events = [json.loads(line) for line in (finished_run.folder / "log.jsonl").read_text().splitlines()]
    skipped = {e["text"].split(":")[0] for e in events if e["event"] == "skipped"}
    # The hands of this clip never let go, so nothing is to be done between grasps.
    assert skipped & {stage.name for stage in UNGUIDED} <= {"regrasp", "object-completion"}
    for index, stage in enumerate(UNGUIDED):
        if stage.name in skipped:
            continue
        assert {"event": "stage", "stage": stage.name, "index": index, "stages": len(UNGUIDED)} in events
        steps = [e for e in events if e["event"] == "step" and e["stage"] == stage.name]
        expected = stage.steps if isinstance(stage, OptimizeStage) else 0
        assert [e["step"] for e in steps] == list(range(1, expected + 1))
        for event in steps:
            assert isinstance(stage, OptimizeStage)
            assert event["terms"].keys() == stage.weights.keys()
            total = sum(stage.weights[name] * value for name, value in event["terms"].items())
            assert event["loss"] == pytest.approx(total, rel=1e-4)
            assert event["seconds"] > 0
    coarse = [e["loss"] for e in events if e["event"] == "step" and e["stage"] == "hands-coarse"]
    assert coarse[-1] < 0.7 * coarse[0]


def test_the_checkpoint_is_at_the_plans_end(finished_run: Run) -> None:
    with safe_open(finished_run.folder / "checkpoints" / "latest.safetensors", framework="np") as file:
        assert json.loads(file.metadata()["position"]) == {"stage": len(UNGUIDED), "step": None}
        assert all(np.isfinite(file.get_tensor(key)).all() for key in file.keys())  # noqa: SIM118


@pytest.mark.parametrize(
    ("name", "part", "points"), [("hand", "right", "points"), ("object", "object", "means")]
)
def test_gaussians(
    finished_run: Run, scene: dict[str, np.ndarray], name: str, part: str, points: str
) -> None:
    vertices, faces = read_ply(finished_run.folder / "gaussians" / f"{name}.ply")
    assert faces is None
    np.testing.assert_allclose(positions(vertices), scene[f"{part}.splats.{points}"], atol=1e-6)
    for i in range(3):
        color = 0.5 + 0.28209479177387814 * vertices[f"f_dc_{i}"]
        np.testing.assert_allclose(color, scene[f"{part}.splats.colors"][:, i], atol=1e-5)
        np.testing.assert_allclose(
            np.exp(vertices[f"scale_{i}"]), scene[f"{part}.splats.scales"][:, i], rtol=1e-4
        )
    opacity = 1 / (1 + np.exp(-vertices["opacity"]))
    np.testing.assert_allclose(opacity, scene[f"{part}.splats.opacities"], atol=1e-4)
    assert 0.5 < opacity.mean() <= 1
    assert np.ptp(positions(vertices), axis=0).max() < 0.35  # metres


def test_both_hands_are_one(scene: dict[str, np.ndarray]) -> None:
    for name in (key for key in scene if key.startswith("right.splats.")):
        np.testing.assert_array_equal(scene[name], scene[name.replace("right", "left")])


def test_poses(
    finished_run: Run, scene: dict[str, np.ndarray], tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    """The file's own formulas lead to the scene's joints and vertices."""
    with np.load(finished_run.folder / "poses.npz", allow_pickle=False) as stored:
        poses = {key: stored[key] for key in stored.files}
    assert tuple(poses["frame_names"]) == tiny.frame_names
    np.testing.assert_allclose(poses["K"], tiny.K, rtol=1e-6)
    for side, model in both_hands.items():
        betas = torch.as_tensor(poses[f"{side}_betas"])
        fingers = model.pose_matrices(torch.as_tensor(poses[f"{side}_hand_pose"]))
        orient = torch.as_tensor(Rotation.from_rotvec(poses[f"{side}_global_orient"]).as_matrix()).float()
        wrist = model.rest_joints(betas)[0] + torch.as_tensor(poses[f"{side}_transl"])
        out = model(betas, fingers, orient, wrist)
        np.testing.assert_allclose(out.joints.numpy(), scene[f"{side}.joints"], atol=1e-4)
        np.testing.assert_allclose(out.vertices.numpy(), scene[f"{side}.verts"], atol=1e-4)
        assert scene[f"{side}.joints"][..., 2].min() > 0.2  # before the camera
    eye = poses["object_rotations"] @ poses["object_rotations"].transpose(0, 2, 1)
    np.testing.assert_allclose(eye, np.broadcast_to(np.eye(3), eye.shape), atol=1e-5)
    np.testing.assert_array_equal(poses["object_transl"], scene["object.centers"])
    assert 0.8 < poses["object_scale"] < 1.25


def test_the_challenge_file(finished_run: Run, scene: dict[str, np.ndarray], tiny: Clip) -> None:
    content = torch.load(finished_run.folder / "arctic_preds" / f"{tiny.name}.pt", weights_only=True)
    assert content["full_seq_name"] == tiny.name
    assert content["fnames"][3] == f"./data/{tiny.name}/build/image/0003.png"
    frames, verts = len(tiny), scene["right.verts"].shape[1]
    count = len(scene["object.verts"])
    shapes = {
        **{f"{key}.{side}": (frames, 21, 3) for key in ("j3d_c", "j3d_ra") for side in ("right", "left")},
        **{f"root.{entity}": (frames, 3) for entity in ENTITIES},
        **{f"v3d_c.{side}": (frames, verts, 3) for side in ("right", "left")},
        **{
            f"{key}.object": (frames, count, 3)
            for key in ("v3d_c", "v3d_ra", "v3d_right", "v3d_left", "verts")
        },
        "verts.right": (frames, verts, 3),
        "v_posed.left": (frames, verts, 3),
    }
    assert content.keys() == shapes.keys() | {"fnames", "full_seq_name", "faces"}
    for key, shape in shapes.items():
        assert content[key].shape == shape, key
        assert content[key].dtype == torch.float16 and torch.isfinite(content[key]).all(), key
    half = 1e-3  # metres; float16 near one
    for side in ("right", "left"):
        joints = scene[f"{side}.joints"]
        np.testing.assert_allclose(content[f"j3d_c.{side}"].float(), joints, atol=half)
        np.testing.assert_allclose(content[f"j3d_ra.{side}"].float(), joints - joints[:, :1], atol=half)
        np.testing.assert_allclose(content[f"v3d_c.{side}"].float(), scene[f"{side}.verts"], atol=half)
    obj = scene["object.scale"] * scene["object.verts"] @ scene["object.rotations"].transpose(0, 2, 1)
    obj = obj + scene["object.centers"][:, None]
    np.testing.assert_allclose(content["v3d_c.object"].float(), obj, atol=half)
    np.testing.assert_allclose(
        content["v3d_left.object"].float(), obj - scene["left.joints"][:, None, 0], atol=half
    )
    shift = tiny.normalize_shift
    scaled = 2 / np.linalg.norm(shift) * (obj * [1, -1, -1] + shift)
    np.testing.assert_allclose(content["verts.object"].float(), scaled, atol=4 * half)
    assert content["faces"]["object"].max() < count


def test_the_mesh(finished_run: Run, scene: dict[str, np.ndarray]) -> None:
    vertices, faces = read_ply(finished_run.folder / "meshes" / "object.ply")
    assert faces is not None and faces.max() < len(vertices["x"])
    metric = scene["object.scale"] * scene["object.verts"]
    np.testing.assert_allclose(positions(vertices), metric, atol=1e-6)
    np.testing.assert_array_equal(faces, scene["object.faces"])


def test_the_result_projects_onto_the_masks(scene: dict[str, np.ndarray], tiny: Clip) -> None:
    shares = []
    for t in range(0, len(tiny), 3):
        labels = tiny.mask(t)
        for side in ("right", "left"):
            pixels = scene[f"{side}.verts"][t] @ tiny.K.T
            column, row = np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int).T
            inside = (column >= 0) & (column < tiny.width) & (row >= 0) & (row < tiny.height)
            assert inside.mean() > 0.95
            shares.append((labels[row[inside], column[inside]] != 0).mean())
    # A few steps: a single frame may still be off.
    assert np.mean(shares) > 0.85 and min(shares) > 0.6


def test_pictures(finished_run: Run, tiny: Clip) -> None:
    with Image.open(finished_run.folder / "preview.png") as picture:
        assert picture.width > 3 * tiny.width and picture.height > 3 * tiny.height
        assert np.asarray(picture.convert("RGB")).std() > 20
    av = pytest.importorskip("av")
    with av.open(str(finished_run.folder / "preview.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == len(tiny)
    assert frames[0].shape[0] == tiny.height and frames[0].shape[1] == 3 * tiny.width
    # The left third is the clip's own frame.
    difference = frames[5][:, : tiny.width].astype(float) - tiny.image(5)
    assert np.abs(difference).mean() < 12


def test_the_report_stands_alone(finished_run: Run, tiny: Clip) -> None:
    text = (finished_run.folder / "report.html").read_text()
    assert tiny.name in text and "MPJPE" in text and "data:image/" in text
    assert re.search(r"\d+% of every picture, where hands and object never are \([\d.]+ s\)", text)
    told = r"touch it, x [\d.]+( ± [\d.]+)? by the depths of grasps; in the end ([\d.]+) of the estimate"
    found = re.search(told, text)
    size = np.load(finished_run.folder / "poses.npz")["object_scale"]
    assert found is not None and float(found[2]) == pytest.approx(size, abs=6e-4)
    for word in ('src="http', 'href="http', "<script src", '<link rel="stylesheet"', "@import"):
        assert word not in text


def test_eval_repeats_the_scores(
    call: Callable[..., Answer], finished_run: Run, tiny_clip: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "scene.safetensors").write_bytes((finished_run.folder / "scene.safetensors").read_bytes())
    answer = call("eval", run, "--gt", tiny_clip)
    assert answer.code == 0 and "MPJPE" in answer.out
    again = json.loads((run / "metrics.json").read_text())["result"]
    first = json.loads((finished_run.folder / "metrics.json").read_text())["result"]
    assert again == pytest.approx({key: first[key] for key in again}, rel=1e-6)


def test_info(call: Callable[..., Answer], tiny_clip: Path) -> None:
    answer = call("info", tiny_clip)
    assert answer.code == 0 and answer.err == ""
    assert "12, 120 x 90" in answer.out
    for entity in ENTITIES:
        assert f"{entity} " in answer.out
    assert "visible in 12 frames" in answer.out
