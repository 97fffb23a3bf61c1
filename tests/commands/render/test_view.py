"""What the live viewer is given: the run's own arrays, and what its knobs make of them."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import Answer, Run, assert_refused

from bigs.checks import InputError
from bigs.commands.folder.clip import clip_of_run
from bigs.commands.folder.contents import load_run
from bigs.commands.render.live import drawable, make_stage
from bigs.data.ground_truth import load_ground_truth
from bigs.models.playback import Playback
from bigs.raster import rasterization
from bigs.types import Gaussians

pytestmark = pytest.mark.slow
FRAME = 4
SUBJECTS = {"right hand": "right", "left hand": "left", "object": "object"}


@pytest.fixture(scope="module")
def playback(finished_run: Run) -> Playback:
    return load_run(finished_run.folder)


def test_at_rest_it_shows_the_run(playback: Playback) -> None:
    stage = make_stage(playback, None, None)
    shown, trajectory = stage.show(FRAME, {}), playback.trajectory()
    assert tuple(shown) == tuple(stage.colors) == tuple(stage.knobs) == tuple(SUBJECTS)
    for name, entity in SUBJECTS.items():
        gaussians, splats = playback.gaussians([FRAME], [entity]), shown[name].splats
        np.testing.assert_allclose(splats.means, gaussians.means[0], atol=1e-7)
        np.testing.assert_allclose(splats.colors, gaussians.colors[0], atol=1e-6)
        # A covariance has the squares of the scales as its eigenvalues, whatever way it is turned, and beside
        # them what a Gaussian was spread in the clip's picture.
        spread = np.sort(np.linalg.eigvalsh(splats.covariances.astype(float)), axis=1)
        pixel = gaussians.means[0, :, 2:].numpy() / playback.K[0, 0].item()
        expected = np.sort(gaussians.scales.numpy() ** 2, axis=1) + 0.3 * pixel**2
        np.testing.assert_allclose(spread, expected, rtol=1e-3)
        true = trajectory.object_verts if entity == "object" else trajectory.verts[entity]
        np.testing.assert_allclose(shown[name].mesh.verts, true[FRAME], atol=1e-7)


def test_a_surface_that_is_closed_in_the_clip_is_closed_from_nearby() -> None:
    """Little Gaussians 2 mm apart, 60 cm away where a pixel is 2.4 mm wide, seen eight times as large."""
    places = 0.002 * torch.arange(-20.0, 21.0)
    x, y = torch.meshgrid(places, places, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, 0.6)], dim=-1).reshape(1, -1, 3)
    count = means.shape[1]
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(1, count, 4)
    wall = Gaussians(
        means, quats, torch.full((count, 3), 6e-4), torch.full((count,), 0.9), means[0] * 0 + 0.5
    )
    K = torch.tensor([[250.0, 0.0, 8.0], [0.0, 250.0, 8.0], [0.0, 0.0, 1.0]])
    near = torch.tensor([[2000.0, 0.0, 32.0], [0.0, 2000.0, 32.0], [0.0, 0.0, 1.0]])

    def least_alpha(scales: torch.Tensor, camera: torch.Tensor, size: int) -> float:
        seen = wall._replace(quats=quats[0], means=means[0], scales=scales)
        return float(rasterization(*seen, torch.eye(4)[None], camera[None], size, size).alphas.min())

    shown = torch.as_tensor(drawable(wall, K).covariances)
    assert least_alpha(wall.scales, K, 16) > 0.8
    assert least_alpha(wall.scales, near, 64) < 0.7
    assert least_alpha(shown.diagonal(dim1=1, dim2=2).sqrt(), near, 64) > 0.8


@pytest.mark.parametrize(
    ("subject", "knob"),
    [("right hand", "index"), ("left hand", "thumb"), ("object", "turn about y")],
)
def test_a_knob_moves_its_subject_alone(playback: Playback, subject: str, knob: str) -> None:
    stage = make_stage(playback, None, None)
    low, high = stage.knobs[subject][knob]
    assert low < 0 < high
    before, after = stage.show(FRAME, {}), stage.show(FRAME, {(subject, knob): 45.0})
    for name in SUBJECTS:
        moved = np.abs(after[name].splats.means - before[name].splats.means).max()
        mesh = np.abs(after[name].mesh.verts - before[name].mesh.verts).max()
        assert (moved > 0.005 and mesh > 0.005) if name == subject else moved == mesh == 0.0


def test_the_truth_is_matched_by_name(playback: Playback, tiny_clip: Path) -> None:
    truth = load_ground_truth(tiny_clip)
    order = np.arange(len(playback))[::-1]
    backwards = replace(
        truth,
        frame_names=tuple(truth.frame_names[t] for t in order),
        verts={side: verts[order] for side, verts in truth.verts.items()},
        joints={side: joints[order] for side, joints in truth.joints.items()},
        object_verts=truth.object_verts[order],
    )
    stage = make_stage(playback, None, backwards)
    shown = stage.truth(FRAME)
    assert set(shown) == set(SUBJECTS)
    np.testing.assert_array_equal(shown["left hand"].verts, truth.verts["left"][FRAME])
    np.testing.assert_array_equal(shown["object"].verts, truth.object_verts[FRAME])


def test_truth_that_is_unknown_is_not_shown(playback: Playback, tiny_clip: Path) -> None:
    truth = load_ground_truth(tiny_clip)
    truth.verts["right"][FRAME] = np.nan
    stage = make_stage(playback, None, truth)
    assert set(stage.truth(FRAME)) == {"left hand", "object"}
    assert set(stage.truth(0)) == set(SUBJECTS)


@pytest.mark.parametrize("missing", ["right", "left", "object"])
def test_what_a_run_lacks_has_no_controls(playback: Playback, missing: str) -> None:
    hands = {side: hand for side, hand in playback.hands.items() if side != missing}
    part = replace(playback, hands=hands, object=None if missing == "object" else playback.object)
    stage = make_stage(part, None, None)
    wanted = {name for name, entity in SUBJECTS.items() if entity != missing}
    assert set(stage.show(0, {})) == set(stage.colors) == set(stage.knobs) == wanted


def test_the_runs_clip_is_found_or_done_without(finished_run: Run, tiny_clip: Path, tmp_path: Path) -> None:
    clip = clip_of_run(finished_run.folder, 12)
    assert clip is not None and clip.folder.resolve().parent == tiny_clip.resolve()
    assert clip_of_run(finished_run.folder, 11) is None  # another clip lies there now
    shutil.copy(finished_run.folder / "scene.safetensors", tmp_path)
    assert clip_of_run(tmp_path, 12) is None
    (tmp_path / "config.yaml").write_text("clip: /nowhere\n")
    assert clip_of_run(tmp_path, 12) is None
    assert clip_of_run(tmp_path, 12, tiny_clip) is not None
    with pytest.raises(InputError, match="expected the 11 frames of"):
        clip_of_run(tmp_path, 11, tiny_clip)


def test_a_missing_extra_is_named(
    call: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch, finished_run: Run
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert_refused(call("view", finished_run.folder), "extra 'viewer'", "found no viser")


def test_a_port_that_is_none(call: Callable[..., Answer], finished_run: Run) -> None:
    assert_refused(call("view", finished_run.folder, "--port", "70000"), "port", "0 to 65535", "found 70000")
