"""Bad clips, hand models, truths and runs: named by file, field, expected and found; nothing is written."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Answer, Run, assert_refused, contents
from PIL import Image

from bigs.hand import HandModel
from bigs.types import Side
from bigs.unpickle import load_npy


class Bomb:
    """Unpickled carelessly, it makes a folder."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.place),)


# --- clips ---


@pytest.fixture
def clip_copy(tiny_clip: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_clip, tmp_path / "clip"))


def edit(clip: Path, change: Callable[[dict[str, Any]], None]) -> None:
    file = clip / "build" / "data.npy"
    data = load_npy(file)
    change(data)
    np.save(file, np.array(data, dtype=np.object_))


def break_clip(clip: Path, how: str) -> None:
    build = clip / "build"
    if how == "no folder":
        shutil.rmtree(clip)
    elif how == "no data":
        (build / "data.npy").unlink()
    elif how == "no images":
        shutil.rmtree(build / "image")
    elif how == "mask of another size":
        Image.new("L", (119, 90)).save(build / "mask" / "0003.png")
    elif how == "image cut short":
        file = build / "image" / "0004.png"
        file.write_bytes(file.read_bytes()[:200])
    elif how == "mask value":
        Image.new("L", (120, 90), 7).save(build / "mask" / "0003.png")
    elif how == "missing mask":
        (build / "mask" / "0011.png").unlink()
    elif how == "NaN pose":
        edit(clip, lambda data: data["entities"]["right"]["hand_poses"].__setitem__((2, 5), np.nan))
    elif how == "frames":
        edit(clip, lambda data: data["entities"]["left"].update(hand_trans=np.zeros((7, 3))))
    elif how == "no entity":
        edit(clip, lambda data: data["entities"].clear())
    elif how == "flat points":
        edit(clip, lambda data: data["entities"]["object"]["pts.cano"].__setitem__((slice(None), 2), 0.0))
    elif how == "code":
        np.save(build / "data.npy", np.array({"a": Bomb(clip.parent / "ran")}, dtype=np.object_))


BROKEN_CLIPS = {
    "no folder": ["clip: ", "expected a clip folder", "found nothing"],
    "no data": ["data.npy: ", "expected", "found no such file"],
    "no images": ["image: ", "expected a folder of frames", "found nothing"],
    "mask of another size": ["0003.png: ", "expected 120 x 90 pixels", "found 119 x 90"],
    "image cut short": ["0004.png: ", "expected a readable image", "found"],
    "mask value": ["0003.png: ", "expected the mask values 0, 50, 150, 250", "found 7"],
    "missing mask": ["mask: ", "expected a mask for each of 12 images", "found 11"],
    "NaN pose": ["data.npy: entities.right.hand_poses: ", "expected finite", "found nan in frame 2"],
    "frames": ["data.npy: entities.left.hand_trans: ", "expected shape [12, 3]", "found [7, 3]"],
    "no entity": ["data.npy: entities: ", "expected at least one of", "found none"],
    "flat points": ["data.npy: entities.object", "pts.cano", "expected points that span a volume", "found"],
    "code": ["data.npy: ", "expected a pickle of plain data", "mkdir", "refused"],
}


@pytest.mark.parametrize("how", BROKEN_CLIPS)
def test_broken_clips(call: Callable[..., Answer], clip_copy: Path, tmp_path: Path, how: str) -> None:
    break_clip(clip_copy, how)
    answer = call("reconstruct", clip_copy, "--out", tmp_path / "out", "--preset", "smoke")
    assert_refused(answer, *BROKEN_CLIPS[how])
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("how", [how for how in BROKEN_CLIPS if how != "flat points"])
def test_info_says_the_same(call: Callable[..., Answer], clip_copy: Path, how: str) -> None:
    break_clip(clip_copy, how)
    assert_refused(call("info", clip_copy), *BROKEN_CLIPS[how])


# --- hand models ---


def write_model(folder: Path, model: HandModel, how: str, marker: Path) -> Path:
    """A folder with MANO_RIGHT in which something is wrong; returns what to pass as --hand-model."""
    folder.mkdir()
    fields: dict[str, Any] = {
        "v_template": model.v_template.numpy(),
        "f": model.faces.numpy(),
        "shapedirs": model.shapedirs.numpy(),
        "posedirs": model.posedirs.numpy(),
        "weights": model.lbs_weights.numpy(),
        "J_regressor": model.J_regressor.numpy(),
        "kintree_table": np.stack([np.array([2**32 - 1, *model.parents[1:]]), np.arange(16)]),
        "hands_mean": model.hands_mean.numpy().ravel(),
        "tip_vertex_ids": model.tip_vertex_ids.numpy(),
    }
    if how == "missing":
        return folder / "nothing"
    if how == "empty folder":
        return folder
    if how == "suffix":
        (folder / "hand.txt").write_text("hand")
        return folder / "hand.txt"
    if how == "code":
        (folder / "MANO_RIGHT.pkl").write_bytes(pickle.dumps({**fields, "v_template": Bomb(marker)}))
        return folder
    if how == "not a pickle":
        (folder / "MANO_RIGHT.pkl").write_bytes(b"hello")
        return folder
    if how == "field":
        del fields["weights"]
    if how == "shape":
        fields["weights"] = fields["weights"][:, :15]
    if how == "nan":
        fields["v_template"] = np.where(np.arange(3) == 1, np.nan, fields["v_template"])
    if how == "left":
        fields["v_template"] = fields["v_template"] * [-1, 1, 1]
    np.savez(folder / "MANO_RIGHT.npz", **fields)
    return folder


BROKEN_MODELS = {
    "missing": ["nothing: ", "expected a hand model", "found nothing"],
    "empty folder": ["model: ", "expected MANO_RIGHT.npz or MANO_RIGHT.pkl", "found neither"],
    "suffix": ["hand.txt: ", "expected", ".npz or .pkl", "found"],
    "code": ["MANO_RIGHT.pkl: ", "expected a pickle of plain data", "mkdir", "refused"],
    "not a pickle": ["MANO_RIGHT.pkl: ", "expected a readable pickle", "found"],
    "field": ["MANO_RIGHT.npz: ", "expected", "weights", "found"],
    "shape": ["MANO_RIGHT.npz", "weights", "expected shape", "found"],
    "nan": ["MANO_RIGHT.npz", "v_template", "expected finite values", "found nan"],
    "left": ["MANO_RIGHT.npz", "expected", "right", "found"],
}


@pytest.mark.parametrize("how", BROKEN_MODELS)
def test_broken_hand_models(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path, both_hands: dict[Side, HandModel], how: str
) -> None:
    model = write_model(tmp_path / "model", both_hands["right"], how, tmp_path / "ran")
    out = tmp_path / "out"
    answer = call("reconstruct", tiny_clip, "--out", out, "--preset", "smoke", "--hand-model", model)
    assert_refused(answer, *BROKEN_MODELS[how])
    assert not out.exists()
    assert not (tmp_path / "ran").exists()


# --- other files ---


@pytest.mark.parametrize("content", [None, b"hello"])
def test_broken_networks(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path, content: bytes | None
) -> None:
    file, out = tmp_path / "vgg.pth", tmp_path / "out"
    if content is not None:
        file.write_bytes(content)
    answer = call(
        *("reconstruct", tiny_clip, "--out", out, "--preset", "smoke", "--perceptual-weights", file)
    )
    assert_refused(answer, "vgg.pth: ", "expected", "found")
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ["gt.npz: ", "expected ground truth", "found no such file"]),
        (b"PK\x03\x04", ["gt.npz: ", "expected ground truth, an .npz", "found"]),
    ],
)
def test_broken_ground_truth(
    call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path, content: bytes | None, words: list[str]
) -> None:
    truth, out = tmp_path / "gt.npz", tmp_path / "out"
    if content is not None:
        truth.write_bytes(content)
    answer = call("reconstruct", tiny_clip, "--out", out, "--preset", "smoke", "--gt", truth)
    assert_refused(answer, *words)
    assert not out.exists()


def test_truth_of_another_clip(call: Callable[..., Answer], clip_copy: Path, tmp_path: Path) -> None:
    """Different frame names are found out before the fit, not after."""
    truth = Path(shutil.copytree(clip_copy, tmp_path / "other"))
    names = (truth / "build" / "corres.txt").read_text().splitlines()
    (truth / "build" / "corres.txt").write_text("\n".join(f"x{name}" for name in names))
    out = tmp_path / "out"
    answer = call("reconstruct", clip_copy, "--out", out, "--preset", "smoke", "--gt", truth)
    assert_refused(answer, "frame names", "expected", "found")
    assert not out.exists()


def test_a_broken_configuration(call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path) -> None:
    file = tmp_path / "old.yaml"
    file.write_text("config:\n  sede: 1\n")
    answer = call("reconstruct", tiny_clip, "--out", tmp_path / "out", "--config", file)
    assert_refused(answer, "old.yaml: ", "expected one of seed", "found 'sede'; did you mean seed?")
    assert not (tmp_path / "out").exists()


# --- where to ---


def test_out_is_a_file(call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.write_text("keep me")
    answer = call("reconstruct", tiny_clip, "--out", out, "--preset", "smoke")
    assert_refused(answer, "out: ", "expected", "found")
    assert out.read_text() == "keep me"


def test_out_is_below_a_file(call: Callable[..., Answer], tiny_clip: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("keep me")
    answer = call("reconstruct", tiny_clip, "--out", tmp_path / "file" / "out", "--preset", "smoke")
    assert_refused(answer, "file")


def test_the_demo_does_not_overwrite(call: Callable[..., Answer], tmp_path: Path) -> None:
    (tmp_path / "demo" / "run").mkdir(parents=True)
    answer = call("demo", "--out", tmp_path / "demo", "--preset", "smoke")
    assert_refused(answer, "demo: ", "expected a new or empty folder", "remove it")
    assert [path.name for path in (tmp_path / "demo").iterdir()] == ["run"]


# --- run folders ---


@pytest.mark.parametrize(
    "command", ["eval RUN --gt GT", "render RUN --cameras C --out O", "export RUN --format ply"]
)
@pytest.mark.parametrize("what", ["missing", "file", "unfinished", "damaged"])
def test_runs_that_are_none(
    call: Callable[..., Answer], tmp_path: Path, tiny_clip: Path, command: str, what: str
) -> None:
    run = tmp_path / "run"
    words = {
        "missing": ["run: ", "expected a run folder", "found nothing"],
        "file": ["run: ", "expected a run folder", "found a file"],
        "unfinished": ["scene.safetensors: ", "expected a finished run", "found no such file"],
        "damaged": ["scene.safetensors: ", "expected a scene file", "found a damaged one"],
    }[what]
    if what == "file":
        run.write_text("")
    elif what != "missing":
        run.mkdir()
    if what == "damaged":
        (run / "scene.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0{}")
    before = sorted(tmp_path.rglob("*"))
    places = {"RUN": run, "GT": tiny_clip, "C": tmp_path / "c.json", "O": tmp_path / "pictures"}
    assert_refused(call(*(places.get(argument, argument) for argument in command.split())), *words)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.fixture
def run_copy(finished_run: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_run.folder, tmp_path / "run"))


@pytest.mark.slow
def test_an_existing_run_is_left_alone(call: Callable[..., Answer], tiny_clip: Path, run_copy: Path) -> None:
    before = contents(run_copy)
    answer = call("reconstruct", tiny_clip, "--out", run_copy, "--preset", "smoke")
    assert_refused(answer, "run: ", "expected a new run folder", "found a run", "--resume")
    assert contents(run_copy) == before


@pytest.mark.slow
def test_resuming_something_else_leaves_the_run_alone(
    call: Callable[..., Answer], tiny_clip: Path, run_copy: Path
) -> None:
    """A checkpoint of another configuration is refused before config.yaml is replaced."""
    before = contents(run_copy)
    answer = call(
        "reconstruct", tiny_clip, "--out", run_copy, "--preset", "smoke", "--set=seed=5", "--resume"
    )
    assert_refused(answer, "--set seed: expected 0, as the run has it", "found 5")
    assert contents(run_copy) == before


@pytest.mark.slow
def test_a_truncated_checkpoint_leaves_the_run_alone(
    call: Callable[..., Answer], tiny_clip: Path, run_copy: Path
) -> None:
    file = run_copy / "checkpoints" / "latest.safetensors"
    file.write_bytes(file.read_bytes()[:-10])
    before = contents(run_copy)
    answer = call("reconstruct", tiny_clip, "--out", run_copy, "--preset", "smoke", "--resume")
    assert_refused(answer, "latest.safetensors: ", "expected a checkpoint", "found a damaged file")
    assert contents(run_copy) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame_index": 12}, ["frames[0].frame_index: ", "expected at most 11", "found 12"]),
        ({"k1": 0.1}, ["frames[0].k1: ", "expected a camera without distortion", "found 0.1"]),
        ({"transform_matrix": [[1, 0], [0, 1]]}, ["transform_matrix", "expected", "found"]),
        ({"fl_x": 0}, ["frames[0].fl_x: ", "expected a positive focal length", "found 0"]),
    ],
)
def test_cameras_that_cannot_be(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path, change: dict[str, Any], words: list[str]
) -> None:
    frame = {"frame_index": 0, "transform_matrix": np.eye(4).tolist(), "w": 8, "h": 8, "fl_x": 9}
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"frames": [frame | change]}))
    answer = call("render", finished_run.folder, "--cameras", file, "--out", tmp_path / "pictures")
    assert_refused(answer, "cameras.json: ", *words)
    assert not (tmp_path / "pictures").exists()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["render RUN --cameras C --out O", "export RUN --format ply --out O"])
def test_results_do_not_go_into_a_file(
    call: Callable[..., Answer], finished_run: Run, tmp_path: Path, command: str
) -> None:
    out, file = tmp_path / "out", tmp_path / "cameras.json"
    out.write_text("keep me")
    frame = {"frame_index": 0, "transform_matrix": np.eye(4).tolist(), "w": 8, "h": 8, "fl_x": 9}
    file.write_text(json.dumps({"frames": [frame]}))
    places = {"RUN": finished_run.folder, "C": file, "O": out}
    assert_refused(call(*(places.get(argument, argument) for argument in command.split())), "out")
    assert out.read_text() == "keep me"


@pytest.mark.slow
def test_scores_against_another_truth_leave_the_run_alone(
    call: Callable[..., Answer], run_copy: Path, clip_copy: Path
) -> None:
    names = (clip_copy / "build" / "corres.txt").read_text().splitlines()
    (clip_copy / "build" / "corres.txt").write_text("\n".join(f"x{name}" for name in names))
    before = contents(run_copy)
    assert_refused(call("eval", run_copy, "--gt", clip_copy), "frame names", "expected", "found")
    assert contents(run_copy) == before
