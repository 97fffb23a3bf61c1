"""The product: a clip goes in, a run folder comes out; readers that share no code with it read it back."""

from __future__ import annotations

import copy
import json
import math
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from command_line import Answer, Run, run_bigs
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation
from small_vgg import torchvision_state

from bigs.commands.reconstruct import reconstruct
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.train.config import GuidanceStage, OptimizeStage, RunConfig
from bigs.train.presets import PRESETS
from bigs.types import Side
from bigs.unpickle import load_npy

pytestmark = pytest.mark.slow

ENTITIES = ("right", "left", "object")
# The stages of a run without a diffusion prior.
UNGUIDED = [stage for stage in PRESETS["smoke"].stages if not isinstance(stage, GuidanceStage)]


def read_ply(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Vertex properties and triangles of a binary little-endian PLY, by the format's specification."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in header.decode().splitlines()]
    assert lines[0] == ["ply"] and lines[1] == ["format", "binary_little_endian", "1.0"]
    codes = {"float": "f", "double": "d", "uchar": "B", "int": "i", "uint": "I"}
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in lines[2:]:
        if line[0] == "element":
            elements.append((line[1], int(line[2]), []))
        elif line[0] == "property":
            elements[-1][2].append(line[1:])
    assert elements[0][0] == "vertex"
    _, count, properties = elements[0]
    row = struct.Struct("<" + "".join(codes[kind] for kind, _ in properties))
    table = np.array([row.unpack_from(body, row.size * i) for i in range(count)])
    vertices = {name: table[:, i] for i, (_, name) in enumerate(properties)}
    rest = body[row.size * count :]
    if len(elements) == 1:
        assert rest == b""
        return vertices, None
    _, faces, ((_, kind, item, _),) = elements[1]
    row = struct.Struct(f"<{codes[kind]}3{codes[item]}")
    triangles = np.array([row.unpack_from(rest, row.size * i) for i in range(faces)])
    assert (triangles[:, 0] == 3).all() and len(rest) == row.size * faces
    return vertices, triangles[:, 1:]


def positions(vertices: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([vertices[axis] for axis in "xyz"], axis=-1)


@pytest.fixture(scope="module")
def scene(finished_run: Run) -> dict[str, np.ndarray]:
    return load_file(finished_run.folder / "scene.safetensors")


# --- the finished run ---


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
    assert list(stages) == [stage.name for stage in PRESETS["smoke"].stages]
    assert stages["joint"]["steps"] == 12
    assert stages["joint"]["lrs"]["hand.ray"] > 0


def test_the_log_has_every_step(finished_run: Run) -> None:
    events = [json.loads(line) for line in (finished_run.folder / "log.jsonl").read_text().splitlines()]
    for index, stage in enumerate(UNGUIDED):
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
    for word in ('src="http', 'href="http', "<script src", '<link rel="stylesheet"', "@import"):
        assert word not in text


# --- what comes after ---


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


# --- killed and resumed ---


def wait_for(log: Path, text: str, process: subprocess.Popen[bytes]) -> None:
    until = time.monotonic() + 60
    while not (log.exists() and text in log.read_text()):
        assert process.poll() is None, "ended before it could be killed"
        assert time.monotonic() < until
        time.sleep(0.005)


def test_killed_twice_and_resumed_it_ends_the_same(finished_run: Run, tmp_path: Path) -> None:
    """Within a stage between two checkpoints, and again in a later stage; to the same bytes."""
    out = tmp_path / "run"
    # How often checkpoints are kept does not change the result.
    command = [*finished_run.command, "--set", "checkpoint_every=4", "--out", str(out)]
    for stage, step in (("hands-coarse", 10), ("appearance", 2)):
        process = subprocess.Popen(
            [sys.executable, "-m", "bigs.cli", *command, "--resume"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_for(out / "log.jsonl", f'"step", "stage": "{stage}", "step": {step},', process)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert not (out / "scene.safetensors").exists()
    answer = run_bigs(*command, "--resume")
    assert answer.code == 0, answer.err
    expected, found = (load_file(folder / "scene.safetensors") for folder in (finished_run.folder, out))
    assert expected.keys() == found.keys()
    assert [key for key in expected if not np.array_equal(expected[key], found[key])] == []
    scores = [json.loads((folder / "metrics.json").read_text()) for folder in (finished_run.folder, out)]
    assert scores[0] == scores[1]
    bytes_of = [(folder / "scene.safetensors").read_bytes() for folder in (finished_run.folder, out)]
    assert bytes_of[0] == bytes_of[1]


def test_a_log_cut_short_does_not_stop_a_resume(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path
) -> None:
    """A power cut may leave half a line; every number in it will be computed again."""
    out = tmp_path / "run"
    (out / "checkpoints").mkdir(parents=True)
    for name in ("config.yaml", "checkpoints/latest.safetensors", "log.jsonl"):
        (out / name).write_bytes((finished_run.folder / name).read_bytes())
    with (out / "log.jsonl").open("a") as file:
        file.write('{"event": "step", "stage": "jo')
    answer = call(*finished_run.command[:4], "--out", out, "--resume")
    assert answer.code == 0, answer.err
    for line in (out / "log.jsonl").read_text().splitlines():
        json.loads(line)


def test_a_resumed_log_has_every_step_once(tiny_clip: Path, tmp_path: Path) -> None:
    """Steps after the last checkpoint are run again; the report's curves must not go back in time."""
    stage = replace(copy.deepcopy(PRESETS["smoke"].stages[0]), steps=6)
    config = replace(PRESETS["smoke"], stages=(stage,), checkpoint_every=2)

    def interrupt(event: dict[str, Any]) -> None:
        if event["event"] == "step" and event["step"] == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(tiny_clip, tmp_path / "run", config, listen=interrupt)
    reconstruct(tiny_clip, tmp_path / "run", config, resume=True)
    events = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [e["step"] for e in events if e["event"] == "step"] == [1, 2, 3, 4, 5, 6]


def test_before_the_first_checkpoint_options_may_change(tiny_clip: Path, tmp_path: Path) -> None:
    """What is run and what config.yaml says are one; there is nothing yet that could be lost."""
    stage = replace(copy.deepcopy(PRESETS["smoke"].stages[0]), steps=2)
    config = replace(PRESETS["smoke"], stages=(stage,))

    def interrupt(event: dict[str, Any]) -> None:
        if event["event"] == "step":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(tiny_clip, tmp_path / "run", config, listen=interrupt)
    reconstruct(tiny_clip, tmp_path / "run", replace(config, seed=3), resume=True)
    assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["config"]["seed"] == 3
    events = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [e["step"] for e in events if e["event"] == "step"] == [1, 2]


# --- other clips and plans ---


def short(config: RunConfig, steps: int = 2) -> RunConfig:
    """The same plan with hardly any steps."""
    stages = tuple(
        replace(stage, steps=steps) if isinstance(stage, OptimizeStage) else stage
        for stage in copy.deepcopy(config.stages)
    )
    return replace(config, stages=stages)


def without(clip: Path, entities: list[str], target: Path) -> Path:
    """A copy of a clip whose data and masks lack some entities."""
    values = {"object": 50, "right": 150, "left": 250}
    build = target / "build"
    for sub in ("image", "mask"):
        (build / sub).mkdir(parents=True)
    for source in sorted((clip / "build" / "image").iterdir()):
        (build / "image" / source.name).write_bytes(source.read_bytes())
        mask = np.asarray(Image.open(clip / "build" / "mask" / source.name)).copy()
        mask[np.isin(mask, [values[entity] for entity in entities])] = 0
        Image.fromarray(mask).save(build / "mask" / source.name)
    (build / "corres.txt").write_text((clip / "build" / "corres.txt").read_text())
    data = load_npy(clip / "build" / "data.npy")
    for entity in entities:
        del data["entities"][entity]
    np.save(build / "data.npy", np.array(data, dtype=np.object_))
    return target


@pytest.mark.parametrize("lacking", ["left", "right", "right left", "object", "left object"])
def test_clips_that_lack_something(tiny_clip: Path, tmp_path: Path, lacking: str) -> None:
    absent = lacking.split()
    present = set(ENTITIES) - set(absent)
    clip = without(tiny_clip, absent, tmp_path / "clip")
    out = tmp_path / "run"
    # Scoring an object takes longer than these few steps; once is enough.
    truth = tiny_clip / "gt.npz" if lacking in ("left", "object") else None
    outcome = reconstruct(clip, out, short(PRESETS["smoke"]), ground_truth=truth)
    scores = json.loads((out / "metrics.json").read_text())["result"]
    assert scores["psnr_foreground"] > 8
    if truth is not None:
        assert {"mpjpe_ra_r"} <= scores.keys()
        assert ("mpjpe_ra_l" in scores) == ("left" not in absent)
        assert ("cd_icp" in scores) == ("object" not in absent)
    written = load_file(out / "scene.safetensors")
    assert {key.split(".")[0] for key in written} & set(ENTITIES) == present
    assert all(np.isfinite(values).all() for values in written.values())
    with np.load(out / "poses.npz") as poses:
        assert {key.split("_")[0] for key in poses.files} & set(ENTITIES) == present
    assert (out / "gaussians" / "object.ply").exists() == ("object" not in absent)
    assert (out / "gaussians" / "hand.ply").exists() == (not {"right", "left"} <= set(absent))
    assert (out / "preview.png").exists() and (out / "report.html").exists()
    if "object" in present:
        (prediction,) = (out / "arctic_preds").iterdir()
        content = torch.load(prediction, weights_only=True)
        assert {key.split(".")[1] for key in content if key.startswith("v3d_c.")} == present
    told = " ".join(outcome.report.skipped)
    assert ("object-scale-search" in told) == (lacking not in ("left", "right"))


def test_a_clip_with_gaps(tiny_clip: Path, tmp_path: Path) -> None:
    """Frames without an estimate, and frames in which a subject is not seen at all."""
    clip = without(tiny_clip, [], tmp_path / "clip")
    data = load_npy(clip / "build" / "data.npy")
    for entity, gap in (("right", [0, 5]), ("object", [3, 11])):
        valid = np.ones(12, dtype=np.uint8)
        valid[gap] = 0
        data["entities"][entity]["is_valid"] = valid
    data["entities"]["right"]["hand_poses"][[0, 5]] = np.nan
    np.save(clip / "build" / "data.npy", np.array(data, dtype=np.object_))
    for t, value in ((0, 150), (3, 50), (7, None)):
        file = clip / "build" / "mask" / f"{t:04d}.png"
        mask = np.asarray(Image.open(file)).copy()
        mask[mask == value if value else slice(None)] = 0
        Image.fromarray(mask).save(file)
    reconstruct(clip, tmp_path / "run", short(PRESETS["smoke"]))
    written = load_file(tmp_path / "run" / "scene.safetensors")
    assert all(np.isfinite(values).all() for values in written.values())


@pytest.mark.parametrize("frames", [1, 2])
def test_the_shortest_clips(tiny_clip: Path, tmp_path: Path, frames: int) -> None:
    clip = without(tiny_clip, [], tmp_path / "clip")
    for t in range(frames, 12):
        for sub in ("image", "mask"):
            (clip / "build" / sub / f"{t:04d}.png").unlink()
    (clip / "build" / "corres.txt").unlink()
    data = load_npy(clip / "build" / "data.npy")
    cameras = data["cameras"]
    data["cameras"] = {key: value for key, value in cameras.items() if int(key.rsplit("_", 1)[1]) < frames}
    for entity, keys in (
        ("right", ("hand_poses", "hand_trans")),
        ("left", ("hand_poses", "hand_trans")),
        ("object", ("object_poses",)),
    ):
        for key in keys:
            data["entities"][entity][key] = data["entities"][entity][key][:frames]
    np.save(clip / "build" / "data.npy", np.array(data, dtype=np.object_))
    reconstruct(clip, tmp_path / "run", short(PRESETS["smoke"]))
    assert load_file(tmp_path / "run" / "scene.safetensors")["right.joints"].shape == (frames, 21, 3)


@pytest.mark.parametrize("preset", ["fast", "full", "paper"])
def test_every_preset_runs(tiny_clip: Path, tmp_path: Path, preset: str) -> None:
    """All terms, groups and choices of a preset, on small fields and few steps."""
    config = short(PRESETS[preset])
    small = PRESETS["smoke"]
    config = replace(
        config,
        hand=replace(config.hand, subdivisions=0, triplane=small.hand.triplane),
        object=replace(config.object, n_gaussians=500, triplane=small.object.triplane),
        initial=replace(config.initial, surface_resolution=40),
    )
    outcome = reconstruct(tiny_clip, tmp_path / "run", config)
    names = {stage.name for stage in config.stages if not isinstance(stage, GuidanceStage)}
    assert names <= outcome.report.seconds.keys()
    written = load_file(tmp_path / "run" / "scene.safetensors")
    assert all(np.isfinite(values).all() for values in written.values())
    assert ("light" in written) == config.lighting


def test_hands_may_be_kept_apart(tiny_clip: Path, tmp_path: Path) -> None:
    config = short(PRESETS["smoke"])
    config = replace(config, hand=replace(config.hand, shared=False))
    reconstruct(tiny_clip, tmp_path / "run", config)
    written = load_file(tmp_path / "run" / "scene.safetensors")
    assert not np.array_equal(written["right.splats.colors"], written["left.splats.colors"])
    assert not np.array_equal(written["right.betas"], written["left.betas"])


def test_a_network_for_the_perceptual_term(tiny_clip: Path, tmp_path: Path) -> None:
    """Its file goes in by an option, and its path into the configuration."""
    weights, out = tmp_path / "vgg16.pth", tmp_path / "run"
    torch.save(torchvision_state(), weights)
    stages = [stage.name for stage in PRESETS["smoke"].stages if isinstance(stage, OptimizeStage)]
    quick = [f"--set=stages.{stage}.steps=1" for stage in stages]
    answer = run_bigs(
        *(
            "reconstruct",
            tiny_clip,
            "--preset",
            "smoke",
            "--out",
            out,
            "--perceptual-weights",
            weights,
            *quick,
        ),
        *("--set", "stages.joint.weights.perceptual=0.5"),
    )
    assert answer.code == 0, answer.err
    assert "perceptual" not in answer.out
    assert yaml.safe_load((out / "config.yaml").read_text())["config"]["perceptual_weights"] == [str(weights)]
    events = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    (joint,) = [event for event in events if event["event"] == "step" and event["stage"] == "joint"]
    assert joint["terms"]["perceptual"] > 0
