"""A prior completes what was never seen, and leaves what was: with the exact score of known pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from half_seen import HalfSeen, TrueRender, half_seen

from bigs.geometry.mesh import sample_surface
from bigs.metrics.shape import ShapeScore, shape_score
from bigs.raster import RasterSettings
from bigs.train.plan.config import GuidanceStage
from bigs.train.unseen.prior_descent import Guided, coverage_of, follow, guide_object

STAGE = GuidanceStage(image_size=48, steps=200, lr_shift=1e-3)


def unseen_score(scene: HalfSeen, verts: np.ndarray) -> ShapeScore:
    """Of the half that was never seen: samples of the same faces, of a mesh and of the truth."""
    back = scene.truth.faces[(scene.truth.vertices[:, 0] < -0.002)[scene.truth.faces].all(1)]
    return shape_score(
        sample_surface(verts, back, 2000)[0], sample_surface(scene.truth.vertices, back, 2000)[0]
    )


Faults = tuple[list[float], list[float]]


def guided(scene: HalfSeen, stage: GuidanceStage, errors: Faults = ([1.0], [1.0])) -> Guided:
    """Guide with the true render's score; the faults are `errors` before and after."""
    answers = iter(errors)
    coverage = coverage_of(scene.detail.normals, scene.seen)
    denoiser = TrueRender(scene, stage.image_size)
    return guide_object(
        scene.detail,
        coverage,
        scene.orbit,
        denoiser,
        stage,
        RasterSettings(),
        lambda: torch.tensor(next(answers)),
    )


@pytest.mark.slow
def test_the_unseen_half_becomes_the_true_one() -> None:
    """CD_o of the unseen half falls by far more than 60 %, its colours come, and what was seen stays."""
    scene = half_seen()
    with torch.no_grad():
        start = scene.detail()
    done = guided(scene, STAGE)
    with torch.no_grad():
        end = scene.detail()
    moved = follow(torch.as_tensor(scene.verts, dtype=torch.float32), start.means, done.moved)
    before, after = unseen_score(scene, scene.verts), unseen_score(scene, moved.numpy())
    assert after.chamfer.squared < 0.2 * before.chamfer.squared
    assert after.f10 > 95.0 > 50.0 > before.f10
    errors = [(part.colors - scene.whole.colors)[~scene.seen].abs().mean() for part in (start, end)]
    assert errors[1] < 0.5 * errors[0]
    for name in ("means", "scales", "opacities", "colors"):
        torch.testing.assert_close(
            getattr(end, name)[scene.seen], getattr(start, name)[scene.seen], rtol=0, atol=0
        )


@pytest.mark.parametrize("after", [[1.03, 2.0, 1.0], [1.0, 2.0, 1.03]], ids=["error", "size"])
def test_damage_is_undone(after: list[float]) -> None:
    scene = half_seen(300)
    kept = {name: value.clone() for name, value in scene.detail.state_dict().items()}
    done = guided(scene, replace(STAGE, steps=5), errors=([1.0, 2.0, 1.0], after))
    assert done.rolled_back and not done.moved.any() and done.worst == pytest.approx(0.03)
    for name, value in scene.detail.state_dict().items():
        torch.testing.assert_close(value, kept[name], rtol=0, atol=0)


def test_what_shows_a_little_worse_is_kept() -> None:
    done = guided(half_seen(300), replace(STAGE, steps=5), errors=([1.0], [1.019]))
    assert not done.rolled_back and done.moved.any()


def test_no_view_of_what_was_seen() -> None:
    """Every direction from which the prior looks is one that coverage leaves open."""
    scene = half_seen(300)
    asked: list[torch.Tensor] = []

    class Listening(TrueRender):
        def predict(self, noisy, timesteps, conditions):  # type: ignore[no-untyped-def]
            asked.append(conditions.azimuths)
            return super().predict(noisy, timesteps, conditions)

    guide_object(
        scene.detail,
        coverage_of(scene.detail.normals, scene.seen),
        scene.orbit,
        Listening(scene, STAGE.image_size),
        replace(STAGE, steps=30, well_seen=0.3),
        RasterSettings(),
        lambda: torch.ones(1),
    )
    # The front is at azimuth 0; the seen half reaches to a right angle from it.
    assert float(torch.cat(asked).abs().min()) > np.radians(60.0)


def test_the_same_seed_gives_the_same_bits() -> None:
    ends = []
    for _ in range(2):
        scene = half_seen(300)
        ends.append(guided(scene, replace(STAGE, steps=4)).moved)
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=0)


def test_a_mesh_follows_its_gaussians() -> None:
    """All of them moved alike: so does the mesh. One half moved: the other stays."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(400, 3, generator=generator)
    verts = torch.rand(50, 3, generator=generator)
    shift = torch.tensor([0.1, -0.2, 0.3])
    torch.testing.assert_close(follow(verts, means, shift.expand(400, 3)), verts + shift)
    half = torch.where(means[:, :1] < 0.5, shift, torch.zeros(3))
    far = verts[:, 0] > 0.8
    torch.testing.assert_close(follow(verts, means, half)[far], verts[far])
