"""Names out of files: each is one plain component, or an error that shows it before any work begins."""

from __future__ import annotations

import dataclasses
import json
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import Answer, Run, assert_refused, contents
from safetensors import safe_open
from safetensors.torch import save_file

from bigs.checks import InputError
from bigs.commands.batch.job import Job, read_status, run_job
from bigs.commands.batch.manifest import read_manifest
from bigs.commands.export.formats import write_format
from bigs.commands.folder.contents import SCENE, load_run
from bigs.commands.render.live import view
from bigs.commands.run.series import PlannedRun
from bigs.data.base import Clip
from bigs.data.formats.annotation import Annotation, ObjectTruth
from bigs.data.formats.ho3d import load_ho3d
from bigs.data.formats.hold import load_hold
from bigs.data.formats.sfm_folder import load_sfm_folder
from bigs.data.formats.writers import write_arctic, write_ho3d, write_nerfstudio
from bigs.export.challenge import load_challenge
from bigs.export.submission import check_submission
from bigs.names import MAX_NAME_BYTES, check_inside, check_name, check_path
from bigs.train.plan.presets import PRESETS
from bigs.unpickle import load_npy

HOSTILE = {
    "absolute": "/tmp/elsewhere/name",
    "parent": "../../name",
    "only parent": "..",
    "here": ".",
    "Windows path": "..\\name",
    "drive": "C:name",
    "NUL": "nul\x00byte",
    "line": "two\nlines",
    "surrogate": "\ud800",
    "device": "NUL",
    "device with a suffix": "com1.anything",
    "300 letters": "n" * 300,
    "200 bytes and more": "é" * 101,
    "dot at the end": "name.",
    "blank at the end": "name ",
}
hostile = pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE.keys())


@hostile
def test_hostile_names_are_refused_and_shown(name: str) -> None:
    with pytest.raises(InputError, match=r"^file: field: expected a plain name, found '") as refusal:
        check_name("file: field", name)
    assert len(str(refusal.value)) < 200
    str(refusal.value).encode()  # can be printed anywhere


@pytest.mark.parametrize("value", [None, 5, ["name"], b"name", np.array("name"), ""], ids=str)
def test_what_is_no_text_is_no_name(value: Any) -> None:
    with pytest.raises(InputError, match="expected a plain name"):
        check_name("file: field", value)


@pytest.mark.parametrize(
    "name",
    ["arctic_s03_box_grab_01_1", "Größe 7", "006_mustard", ".clip", "console", "nul_1", "手", "a.b-c+d"],
)
def test_ordinary_names_stay(name: str) -> None:
    assert check_name("file: field", name) == name
    assert check_name("field", np.str_(name)) == name
    assert check_name("field", "n" * MAX_NAME_BYTES)


def test_paths_of_things_to_read() -> None:
    assert check_path("field", "../clips/a b") == "../clips/a b"
    for path in ("a\x00b", "\ud800", "n" * 300, "n/" * 3000, "", 5):
        with pytest.raises(InputError, match=r"^field: expected a path, found"):
            check_path("field", path)
    assert check_inside("field", "./sparse/points.ply") == Path("sparse/points.ply")
    for path in ("/etc/passwd", "../a.ply", "a/../../b", "a//b", "a/nul"):
        with pytest.raises(InputError, match=r"^field: expected"):
            check_inside("field", path)


# --- what reads names ---


def rename(clip: Path, name: Any) -> None:
    file = clip / "build" / "data.npy"
    np.save(file, np.array({**load_npy(file), "seq_name": name}, dtype=np.object_))


def named_clip(clip: Path, folder: Path, name: str) -> Path:
    """A clip like another, whose sequence has this name."""
    (folder / "build").mkdir(parents=True)
    for part in ("image", "mask"):
        (folder / "build" / part).symlink_to(clip / "build" / part)
    for part in ("data.npy", "corres.txt"):
        shutil.copy(clip / "build" / part, folder / "build")
    rename(folder, name)
    return folder


@hostile
def test_a_clip_cannot_write_anywhere(
    name: str, tiny_clip: Path, tmp_path: Path, call: Callable[..., Answer]
) -> None:
    clip = named_clip(tiny_clip, tmp_path / "inside" / "clip", name)
    before = contents(tmp_path)
    for command in (
        ["reconstruct", clip, "--out", tmp_path / "run", "--preset", "smoke"],
        ["info", clip],
        ["convert", clip, "--out", tmp_path / "out"],
    ):
        answer = call(*command)
        assert answer.code == 2
        assert_refused(answer, "data.npy: seq_name: expected a plain name, found '")
    assert contents(tmp_path) == before


@hostile
def test_a_job_of_a_batch(name: str, tiny_clip: Path, tmp_path: Path) -> None:
    """It writes into its own folder alone, and says that another attempt is of no use."""
    clip, folder = named_clip(tiny_clip, tmp_path / "clip", name), tmp_path / "batch" / "job"
    before = contents(tmp_path)
    run_job(Job(PlannedRun(folder, clip, PRESETS["smoke"], None, None), 1, "x"))
    status = read_status(folder)
    assert (status.state, status.again) == ("failed", False)
    assert "data.npy: seq_name: expected a plain name, found '" in status.error
    shutil.rmtree(tmp_path / "batch")
    assert contents(tmp_path) == before


@hostile
def test_members_of_a_submission(name: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "preds.zip", "w") as archive:
        try:
            archive.writestr(f"arctic_preds/{name}.pt", b"")
        except UnicodeEncodeError:
            archive.writestr(f"{name.encode('utf8', 'surrogatepass').decode('cp437')}", b"")
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"preds\.zip: expected") as caught:
        check_submission(tmp_path / "preds.zip", ["one"])
    assert len(str(caught.value).splitlines()) == 1 and contents(tmp_path) == before


@hostile
def test_every_format_refuses_a_scene_of_such_a_name(
    name: str, finished_run: Run, tmp_path: Path, call: Callable[..., Answer]
) -> None:
    run = tmp_path / "inside" / "run"
    run.mkdir(parents=True)
    with safe_open(finished_run.folder / SCENE, framework="pt") as file:
        metadata = {**json.loads(file.metadata()["bigs"]), "name": name, "format": "bigs-scene-3"}
        del metadata["checksum"]  # which that format has not
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    save_file(tensors, run / SCENE, {"bigs": json.dumps(metadata)})
    before = contents(tmp_path)
    for form in ("challenge", "rerun"):  # those that name a file by the scene
        answer = call("export", run, "--format", form, "--out", tmp_path / "out")
        assert answer.code == 2
        assert_refused(answer, "scene.safetensors: name: expected a plain name, found '")
    with pytest.raises(InputError, match=r"scene\.safetensors: name: expected a plain name"):
        view(run, port=0)
    assert contents(tmp_path) == before
    with pytest.raises(InputError, match="expected a plain name"):
        dataclasses.replace(load_run(finished_run.folder), name=name)


def test_every_format_stays_in_its_folder(finished_run: Run, tmp_path: Path) -> None:
    playback = dataclasses.replace(load_run(finished_run.folder), name="n" * MAX_NAME_BYTES).at([0])
    for form in ("challenge", "poses", "ply"):
        for path in write_format(tmp_path / "out", playback, form):
            assert path.resolve().is_relative_to(tmp_path / "out")
            assert path.is_file()


@hostile
def test_frame_names_of_a_clip(name: str, write_clip: Callable[[], Path]) -> None:
    clip = write_clip()
    if "\n" in name or name != name.strip() or "\ud800" in name:
        return  # no line of a text file holds such a name
    lines = (clip / "build" / "corres.txt").read_text().splitlines()
    (clip / "build" / "corres.txt").write_text("\n".join([lines[0], name, *lines[2:]]) + "\n")
    with pytest.raises(InputError, match=r"corres.txt: line 2: expected a plain name"):
        load_hold(clip)


@pytest.fixture
def write_clip(tiny_clip: Path, tmp_path: Path) -> Callable[[], Path]:
    return lambda: Path(shutil.copytree(tiny_clip, tmp_path / "clip"))


@hostile
def test_entries_of_a_manifest(name: str, tmp_path: Path) -> None:
    file = tmp_path / "clips.json"
    file.write_text(json.dumps([{"clip": "a", "name": name}]))
    with pytest.raises(InputError, match=r"clips.json: entry 1: name: expected"):
        read_manifest(file)


@pytest.mark.parametrize("path", ["a\x00b", "\ud800", "n" * 300, "n/" * 3000])
def test_paths_in_a_manifest(path: str, tmp_path: Path) -> None:
    file = tmp_path / "clips.json"
    file.write_text(json.dumps([{"clip": "a", "gt": path}]))
    with pytest.raises(InputError, match=r"clips.json: entry 1: gt: expected a path"):
        read_manifest(file)


def test_names_that_a_manifest_leaves_to_the_folders(tmp_path: Path) -> None:
    file = tmp_path / "clips.txt"
    file.write_text("nul\n")
    with pytest.raises(InputError, match=r"clips.txt: .*nul: name: expected a plain name, found 'nul'"):
        read_manifest(file)


@hostile
def test_predictions_of_others(name: str, finished_run: Run, tmp_path: Path) -> None:
    (file,) = (finished_run.folder / "arctic_preds").glob("*.pt")
    stored = torch.load(file, weights_only=True)
    torch.save({**stored, "full_seq_name": name}, tmp_path / "other.pt")
    with pytest.raises(InputError, match=r"other.pt: full_seq_name: expected a plain name|cannot be read"):
        load_challenge(tmp_path / "other.pt")


@hostile
def test_what_writes_data_sets(name: str, tmp_path: Path, small: Annotation) -> None:
    images = np.zeros((len(small), 16, 24, 3), np.uint8)
    given: dict[str, Any] = {"annotation": small, "images": images}
    out = tmp_path / "inside" / "root"
    for fields in ({"subject": name, "sequence": "box_1"}, {"subject": "s01", "sequence": name}):
        with pytest.raises(InputError, match="expected a plain name"):
            write_arctic(out, **given, **fields)
    opengl = dataclasses.replace(small, cam_from_world=small.cam_from_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
    given |= {"annotation": opengl, "hands_mean": np.zeros((15, 3))}
    for changed in ({"clip": name}, {"object_name": name}, {"split": name}):
        fields = {"clip": "c", "object_name": "o"} | changed
        with pytest.raises(InputError, match="expected a plain name"):
            write_ho3d(out, **given, **fields)
    assert not list(tmp_path.iterdir())


@hostile
def test_object_of_an_ho3d_clip(name: str, tmp_path: Path, small: Annotation) -> None:
    images = np.zeros((len(small), 16, 24, 3), np.uint8)
    opengl = dataclasses.replace(small, cam_from_world=small.cam_from_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
    clip = write_ho3d(
        tmp_path, opengl, clip="c", object_name="o", images=images, hands_mean=np.zeros((15, 3))
    )
    for file in (clip / "meta").glob("*.pkl"):
        file.write_bytes(pickle.dumps({**pickle.loads(file.read_bytes()), "objName": name}))
    with pytest.raises(InputError, match=r"meta/0000.pkl: objName: expected a plain name"):
        load_ho3d(clip, np.zeros((15, 3)))


@hostile
def test_points_of_a_nerfstudio_folder(name: str, tmp_path: Path, tiny: Clip) -> None:
    clip = dataclasses.replace(tiny, cam_from_world=np.repeat(np.eye(4)[None], len(tiny), axis=0))
    folder = write_nerfstudio(tmp_path / "sfm", clip)
    file = folder / "transforms.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "ply_file_path": name}))
    with pytest.raises(InputError, match=r"transforms.json: ply_file_path: expected a"):
        load_sfm_folder(folder)


@pytest.fixture
def small(tiny: Clip) -> Annotation:
    """The tiny clip's hands with a tetrahedron, as an annotation."""
    still = np.repeat(np.eye(4)[None], len(tiny), axis=0)
    obj = ObjectTruth(
        verts=0.1 * np.vstack([np.zeros(3), np.eye(3)]),
        faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        rotations=still[:, :3, :3],
        transl=np.repeat([[0.0, 0.0, 0.5]], len(tiny), axis=0),
        valid=np.ones(len(tiny), dtype=bool),
    )
    return Annotation("small", tiny.frame_names, 24, 16, tiny.K, still, tiny.hands, obj)
