"""Clips that lack a hand, the object, frames or estimates, and very short ones: their results are whole."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from glb_reader import Glb
from PIL import Image
from safetensors.numpy import load_file
from short_plans import short

from bigs.commands.clips.convert import ConvertPlan, convert
from bigs.commands.export.formats import write_format
from bigs.commands.folder.contents import load_run
from bigs.commands.render.live import make_stage
from bigs.commands.render.views import Shot, Wanted, render_run
from bigs.commands.run.reconstruct import reconstruct
from bigs.train.plan.presets import PRESETS
from bigs.train.plan.rate import at_rate
from bigs.types import ENTITIES, MASK_VALUES
from bigs.unpickle import load_npy

pytestmark = pytest.mark.slow


def without(clip: Path, entities: list[str], target: Path) -> Path:
    """A copy of a clip whose data and masks lack some entities."""
    build = target / "build"
    for sub in ("image", "mask"):
        (build / sub).mkdir(parents=True)
    for source in sorted((clip / "build" / "image").iterdir()):
        (build / "image" / source.name).write_bytes(source.read_bytes())
        mask = np.asarray(Image.open(clip / "build" / "mask" / source.name)).copy()
        mask[np.isin(mask, [MASK_VALUES[entity] for entity in entities])] = 0
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


def test_a_clip_of_fewer_frames_a_second(tiny_clip: Path, tmp_path: Path) -> None:
    """Its rate is that of the plan and of everything that plays."""
    convert(tiny_clip, tmp_path / "clip", ConvertPlan(every=3))
    plan = short(PRESETS["smoke"])
    reconstruct(tmp_path / "clip", tmp_path / "run", plan)
    playback = load_run(tmp_path / "run")
    assert (len(playback), playback.fps, make_stage(playback, None, None).fps) == (4, 10.0, 10.0)
    (glb,) = write_format(tmp_path, playback, "glb")
    np.testing.assert_allclose(Glb(glb).times(), [0.0, 0.1, 0.2, 0.3], atol=1e-6)
    # The same as with a plan made for it and a clip of the usual rate.
    convert(tmp_path / "clip", tmp_path / "usual", ConvertPlan(fps=30.0))
    reconstruct(tmp_path / "usual", tmp_path / "again", at_rate(plan, 10.0))
    slow, usual = (load_file(tmp_path / run / "scene.safetensors") for run in ("run", "again"))
    for name, values in slow.items():
        np.testing.assert_array_equal(values, usual[name], err_msg=name)
    reconstruct(tmp_path / "usual", tmp_path / "other", plan)
    other = load_file(tmp_path / "other" / "scene.safetensors")
    assert any(not np.array_equal(values, other[name]) for name, values in slow.items())
    av = pytest.importorskip("av")
    own, still = tmp_path / "own.mp4", tmp_path / "still.mp4"
    render_run(tmp_path / "run", Shot(from_input=True), Wanted(video=own))
    # Where time stands still, no rate is the clip's.
    render_run(tmp_path / "run", Shot(orbit=True, pictures=2), Wanted(video=still))
    for video, rate in ((tmp_path / "run" / "preview.mp4", 10), (own, 10), (still, 30)):
        with av.open(str(video)) as container:
            assert container.streams.video[0].average_rate == rate


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
