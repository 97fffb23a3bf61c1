"""The steps one after the other: what they leave, when they are skipped, and what HOLD reads in the end."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from taken_apart import Given, place_true_object

from bigs.checks import InputError
from bigs.commands.preprocess.all_steps import preprocess
from bigs.commands.preprocess.request import PreprocessRequest, StepOutcome
from bigs.data.formats.hold import load_hold
from bigs.data.ground_truth import load_ground_truth
from bigs.hand import HandModel
from bigs.metrics.report import evaluate
from bigs.preprocess.frames.camera import CameraRequest
from bigs.preprocess.frames.extract import FrameConfig
from bigs.train.start.initial import initial_trajectory
from bigs.types import Side
from bigs.unpickle import load_npy


def request_of(given: Given, clip: Path) -> PreprocessRequest:
    fx, fy, cx, cy = map(float, given.camera[1:])
    return PreprocessRequest(
        clip=clip,
        source=given.pictures,
        frames=FrameConfig(camera=CameraRequest(K=(fx, fy, cx, cy))),
        masks=given.masks,
        keypoints=given.keypoints,
    )


@pytest.fixture(scope="module")
def made(given: Given, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[StepOutcome]]:
    """The clip that the steps make. Read it, never write into it."""
    clip = tmp_path_factory.mktemp("made") / "clip"
    place_true_object(clip, given.truth)
    return clip, preprocess(request_of(given, clip))


@pytest.fixture
def copied(made: tuple[Path, list[StepOutcome]], tmp_path: Path) -> Path:
    return Path(shutil.copytree(made[0], tmp_path / "clip"))


def states(outcomes: list[StepOutcome]) -> dict[str, str]:
    return {outcome.name: outcome.state for outcome in outcomes}


@pytest.mark.slow
def test_every_step_leaves_its_artefact_and_a_picture(made: tuple[Path, list[StepOutcome]]) -> None:
    clip, outcomes = made
    assert states(outcomes) == {
        "frames": "made",
        "masks": "made",
        "hands": "made",
        "object": "supplied",
        "align": "supplied",
        "build": "made",
    }
    for outcome in outcomes:
        if outcome.state == "made":
            assert outcome.picture is not None and outcome.picture.stat().st_size > 1000
    assert len(list((clip / "processed" / "frames").glob("*.png"))) == 12


@pytest.mark.slow
def test_the_clip_is_what_the_truth_says(
    made: tuple[Path, list[StepOutcome]], given: Given, both_hands: dict[Side, HandModel]
) -> None:
    clip, truth = load_hold(made[0]), load_ground_truth(given.truth)
    original = load_hold(given.truth)
    assert np.allclose(clip.K, original.K, atol=1e-2)
    found = initial_trajectory(clip, both_hands)
    # Frames are matched by name; the generator's names carry another number.
    scores = evaluate(replace(found, frame_names=truth.frame_names), truth)
    assert scores["mpjpe_ra_h"] < 12.0
    # Points that close the object come after those that were supplied.
    supplied = truth.object_verts.shape[1]
    assert np.abs(found.object_verts[:, :supplied] - truth.object_verts).max() < 2e-4
    assert np.array_equal(clip.image(3), original.image(3)) and np.array_equal(clip.mask(3), original.mask(3))


@pytest.mark.slow
def test_hold_reads_the_data(made: tuple[Path, list[StepOutcome]], given: Given) -> None:
    """Every key of HOLD's own file and the rate, and the object's points where HOLD's formulas put them."""
    data = load_npy(made[0] / "build" / "data.npy")
    assert data.keys() == {
        "seq_name", "cameras", "scene_bounding_sphere", "max_radius_ratio", "entities", "normalize_shift",
        "fps",
    }  # fmt: skip
    entities = data["entities"]
    assert entities["object"].keys() >= {"obj_scale", "pts.cano", "norm_mat", "object_poses"}
    assert isinstance(entities["object"]["norm_mat"], torch.Tensor)
    assert entities["right"]["hand_poses"].shape == (12, 48)
    assert entities["right"]["hand_poses"].dtype == np.float32
    assert np.linalg.norm(entities["object"]["pts.cano"], axis=1).max() == pytest.approx(1.0, abs=1e-6)
    shift, radius = data["normalize_shift"], data["cameras"]["scale_mat_0"][0, 0]
    assert radius == pytest.approx(np.linalg.norm(shift) / 2)
    truth = load_ground_truth(given.truth)
    inverse = np.linalg.inv(entities["object"]["norm_mat"].double().numpy())
    points = entities["object"]["pts.cano"] @ inverse[:3, :3].T + inverse[:3, 3]
    for t in (0, 7):
        pose = entities["object"]["object_poses"][t]
        turn = Rotation.from_rotvec(pose[:3]).as_matrix()
        world = entities["object"]["obj_scale"] * points @ turn.T + pose[3:]
        pixels = np.column_stack([world, np.ones(len(world))]) @ data["cameras"][f"world_mat_{t}"][:3].T
        expected = truth.object_verts[t] @ load_hold(given.truth).K.T
        # What closes the object comes last.
        pixels = pixels[: len(expected)]
        apart = pixels[:, :2] / pixels[:, 2:] - expected[:, :2] / expected[:, 2:]
        assert np.abs(apart).max() < 0.05
    names = (made[0] / "build" / "corres.txt").read_text().split()
    assert len(names) == 12 and names[0] == "0000.png"


@pytest.mark.slow
def test_a_second_run_does_nothing(copied: Path, given: Given) -> None:
    before = {p: p.stat().st_mtime_ns for p in copied.rglob("*") if p.is_file()}
    outcomes = preprocess(request_of(given, copied))
    assert set(states(outcomes).values()) == {"up to date", "supplied"}
    assert before == {p: p.stat().st_mtime_ns for p in copied.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_a_changed_mask_redoes_what_reads_masks(copied: Path, given: Given, tmp_path: Path) -> None:
    masks = Path(shutil.copytree(given.masks, tmp_path / "masks"))
    shutil.copyfile(masks / "0001.png", masks / "0002.png")
    request = request_of(given, copied)
    changed = replace(request, masks=masks)
    found = states(preprocess(changed))
    assert found["frames"] == "up to date" and found["masks"] == found["hands"] == found["build"] == "made"


@pytest.mark.slow
def test_what_another_tool_supplied_is_kept_and_said(copied: Path, given: Given) -> None:
    file = copied / "processed" / "hands.npz"
    with np.load(file) as stored:
        arrays = {key: stored[key] for key in stored.files if key not in ("inputs", "version")}
    arrays["right.transl"] = arrays["right.transl"] + [0.0, 0.0, 0.1]
    np.savez(file, **arrays)
    before = load_hold(copied).hands["right"].transl
    outcomes = preprocess(request_of(given, copied))
    assert states(outcomes)["hands"] == "supplied" and states(outcomes)["build"] == "made"
    assert any("another tool" in note for outcome in outcomes for note in outcome.notes)
    # A shift in depth does not move the object, so HOLD's world stays where it was: its z points back.
    assert np.allclose(load_hold(copied).hands["right"].transl, before - [0.0, 0.0, 0.1], atol=1e-6)


@pytest.mark.slow
def test_somebody_elses_build_folder_is_not_touched(copied: Path, given: Given) -> None:
    (copied / "processed" / "build.json").unlink()
    before = (copied / "build" / "data.npy").read_bytes()
    with pytest.raises(InputError, match="found another;"):
        preprocess(request_of(given, copied), ("build",))
    assert (copied / "build" / "data.npy").read_bytes() == before


def test_masks_laid_down_by_hand_are_taken(given: Given, tmp_path: Path) -> None:
    clip = tmp_path / "clip"
    request = PreprocessRequest(clip=clip, source=given.pictures)
    preprocess(request, ("frames",))
    shutil.copytree(given.masks, clip / "processed" / "masks")
    (outcome,) = preprocess(request, ("masks",))
    assert outcome.state == "supplied" and outcome.picture is not None
    assert "notes" in json.loads((clip / "processed" / "masks.json").read_text())


def test_a_step_without_its_source_says_what_to_give(given: Given, tmp_path: Path) -> None:
    request = PreprocessRequest(clip=tmp_path / "clip", source=given.pictures)
    preprocess(request, ("frames",))
    for step, words in (
        ("masks", "give --masks DIR"),
        ("hands", "give --keypoints FILE"),
    ):
        with pytest.raises(InputError, match=words):
            preprocess(request, (step,))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"frames\.json: expected what an earlier step writes"):
        preprocess(PreprocessRequest(clip=tmp_path / "other"), ("masks",))


@pytest.mark.parametrize(
    ("shown", "stride", "note"),
    [(2, 1, "--stride 2 skips those"), (2, 2, ""), (9, 3, "--stride 9 skips those"), (1, 1, "")],
)
def test_repeated_pictures_are_told(tmp_path: Path, shown: int, stride: int, note: str) -> None:
    """Each picture is shown so many times, and one of every stride is kept."""
    (tmp_path / "pictures").mkdir()
    pictures = np.random.default_rng(0).integers(0, 255, (60, 24, 32, 3), dtype=np.uint8)
    for t in range(60):
        Image.fromarray(pictures[t // shown]).save(tmp_path / "pictures" / f"{t:04d}.png")
    request = PreprocessRequest(
        clip=tmp_path / "clip",
        source=tmp_path / "pictures",
        frames=FrameConfig(stride=stride, camera=CameraRequest(focal=40.0)),
    )
    (outcome,) = preprocess(request, ("frames",))
    assert len(outcome.notes) == bool(note) and all(note in found for found in outcome.notes)
