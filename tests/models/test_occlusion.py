"""What covers the sky above hands and object: measured from their surfaces, and carried to Gaussians."""

from __future__ import annotations

import pytest
import torch
from small_scene import FRAMES, OBJECT_RADIUS, make_scene

from bigs.models.lighting import Lighting, Occlusion
from bigs.models.occlusion import measure_occlusion
from bigs.models.scene import Scene


@pytest.fixture
def scene() -> Scene:
    return make_scene()


def shares(scene: Scene, entity: str) -> torch.Tensor:
    return scene.lighting.occlusion[entity].shares


def test_shares_are_shares_of_every_frame(scene: Scene) -> None:
    for entity in scene.entities:
        found = shares(scene, entity)
        assert len(found) == FRAMES and found.shape[1] == len(scene.lighting.occlusion[entity].places)
        assert found.min() >= 0.0 and found.max() < 1.0 and found.max() > 0.05


def test_the_object_is_covered_where_a_hand_is_near(scene: Scene) -> None:
    """The right hand is put at its side: that side darkens, and the other keeps what the left hand takes."""
    places = scene.lighting.occlusion["object"].places
    with torch.no_grad():
        for side in scene.sides:
            scene.hand_poses[side].position.log_depth += 5.0
    measure_occlusion(scene)
    assert shares(scene, "object").max() < 1e-3
    middle = scene.at(torch.arange(FRAMES)).object.centers
    offset = torch.tensor([2.0 * OBJECT_RADIUS, 0.0, 0.0])
    verts = scene.at(torch.arange(FRAMES)).verts("right")
    beside = verts - verts.mean(1, keepdim=True) + (middle + offset)[:, None]
    with pytest.MonkeyPatch.context() as patch:
        original = type(scene.at(torch.arange(1))).verts
        patch.setattr(
            type(scene.at(torch.arange(1))),
            "verts",
            lambda self, side: beside if side == "right" else original(self, side),
        )
        measure_occlusion(scene)
    turned = places @ scene.at(torch.arange(FRAMES)).object.rotations.mT
    found = shares(scene, "object")
    towards, away = turned[..., 0] > 0.7 * OBJECT_RADIUS, turned[..., 0] < -0.3 * OBJECT_RADIUS
    assert found[towards].mean() > 0.1 > 20.0 * found[away].mean()


def test_a_lone_hand_covers_only_itself() -> None:
    scene = make_scene(with_object=False, sides=("right",))
    found = shares(scene, "right")
    assert 0.0 < found.mean() < 0.5
    # Wherever it is.
    with torch.no_grad():
        scene.hand_poses["right"].position.log_depth += 1.0
    measure_occlusion(scene)
    torch.testing.assert_close(shares(scene, "right"), found, atol=1e-4, rtol=1e-3)


def test_a_change_of_place_or_points_is_seen() -> None:
    known = Occlusion(2)
    points = torch.rand(7, 3, generator=torch.Generator().manual_seed(0))
    assert not known.at(points).any()
    places = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    values = torch.rand(2, 50, generator=torch.Generator().manual_seed(2))
    known.place(places, values)
    first = known.at(points)
    assert known.at(points) is first
    near = torch.cdist(points, places).topk(3, largest=False).indices
    least, most = values[:, near].amin(-1), values[:, near].amax(-1)
    assert (first >= least - 2e-3).all() and (first <= most + 2e-3).all()
    torch.testing.assert_close(known.at(places), values, atol=5e-3, rtol=0)
    points.copy_(places[:7])
    torch.testing.assert_close(known.at(points), values[:, :7], atol=5e-3, rtol=0)


def test_nothing_is_covered_before_it_is_measured() -> None:
    lighting = Lighting(["right", "object"], 5)
    assert not lighting.measured
    assert not lighting.occlusion["object"].at(torch.rand(4, 3)).any()
    assert make_scene().lighting.measured


def test_what_is_covered_is_darker_by_its_own_strength(scene: Scene) -> None:
    frames = torch.tensor([2, 0])
    with torch.no_grad():
        lit = scene.at(frames).posed(scene.canonical(scene.entities)).colors
        for strength in scene.lighting.ambient.values():
            strength.zero_()
        bare = scene.at(frames).posed(scene.canonical(scene.entities)).colors
        covered = torch.cat(
            [scene.lighting.occlusion[e].at(scene.splats(e).base_points)[frames] for e in scene.entities], 1
        )
        scene.lighting.ambient["left"].fill_(-2.0)
        dark = scene.at(frames).posed(scene.canonical(scene.entities)).colors
    assert not torch.equal(lit, bare)
    counts = [len(scene.splats(e).base_points) for e in scene.entities]
    right, left, _ = torch.split(dark / bare, counts, dim=1)
    assert (right == 1.0).all()
    expected = torch.split(covered, counts, dim=1)[1][..., None].expand_as(left)
    torch.testing.assert_close(left.log(), -2.0 * expected, atol=1e-5, rtol=1e-4)
