"""A scene at its start values: where the estimates say, on a surface that the masks agree with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.data.ground_truth import load_ground_truth
from bigs.geometry.mesh import sample_surface
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.raster import rasterization
from bigs.train.plan.presets import SMOKE
from bigs.train.plan.start_config import CompletionConfig, InitialConfig
from bigs.train.start.build import SceneStart, build_scene, likely_shape
from bigs.train.start.hand_color import hand_color
from bigs.train.start.initial import initial_trajectory
from bigs.types import MASK_VALUES, SIDES, Entity, Side

AS_GIVEN = replace(
    SMOKE.initial, smooth_hands=0.0, smooth_object=0.0, surface_solid=np.inf, surface_kept=np.inf
)


def build(
    clip: Clip,
    hands: dict[Side, HandModel],
    shape_error: float = SMOKE.hand.shape_error,
    initial: InitialConfig = AS_GIVEN,
    completion: CompletionConfig | None = None,
) -> SceneStart:
    torch.manual_seed(0)
    nothing = np.zeros((len(clip), clip.height, clip.width), dtype=bool)
    hand = replace(SMOKE.hand, shape_error=shape_error)
    return build_scene(clip, nothing, hands, initial, hand, SMOKE.object, True, completion)


@pytest.fixture(scope="module")
def scene(tiny: Clip, both_hands: dict[Side, HandModel]) -> Scene:
    built = build(tiny, both_hands)
    assert built.skipped == [] and built.known is None
    return built.scene


@torch.no_grad()
def test_hands_start_at_the_estimates(scene: Scene, tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    """Wrists exactly; the rest up to the shape, which both hands share and doubt."""
    given = initial_trajectory(tiny, both_hands)
    frames = torch.arange(len(tiny))
    for side in SIDES:
        joints = scene.at(frames).joints(side)
        np.testing.assert_allclose(joints[:, 0].numpy(), given.joints[side][:, 0], atol=1e-5)
        assert np.linalg.norm(joints.numpy() - given.joints[side], axis=-1).max() < 0.01
    betas = np.mean([tiny.hands[side].betas for side in SIDES], axis=0)
    doubt = np.mean((tiny.hands["right"].betas - tiny.hands["left"].betas) ** 2) / 4
    doubts = np.array([SMOKE.hand.size_error**2 / 2] + [doubt] * 9)
    np.testing.assert_allclose(scene.betas["right"].numpy(), betas / (1 + doubts), atol=2e-2)


def test_the_likely_shape_is_nearer_than_the_mean() -> None:
    """Many people with unit betas, estimates of either hand with errors of 0.8."""
    generator = torch.Generator().manual_seed(0)
    errors: dict[str, list[float]] = {"mean": [], "likely": [], "one": [], "likely one": []}
    for _ in range(300):
        person = torch.randn(10, generator=generator)
        hands = [person + 0.8 * torch.randn(10, generator=generator) for _ in range(2)]
        for name, found in (
            ("mean", (hands[0] + hands[1]) / 2),
            ("likely", likely_shape(hands, 0.8, 0.0)),
            ("one", hands[0]),
            ("likely one", likely_shape(hands[:1], 0.8, 0.0)),
        ):
            errors[name].append(float((found - person).square().mean()))
    mean = {name: np.mean(values) for name, values in errors.items()}
    assert torch.equal(likely_shape(hands[:1], 0.0, 0.9), hands[0])
    assert mean["likely one"] < 0.75 * mean["one"]
    assert mean["likely"] < 0.95 * mean["mean"]


def test_size_is_drawn_to_the_average_hand_by_its_own_error() -> None:
    """Two estimates that agree say little of size: one difference is no measure of it."""
    agreeing = [torch.full((10,), 2.0)] * 2
    found = likely_shape(agreeing, 0.6, 0.9)
    assert float(found[0]) == pytest.approx(2.0 / (1.0 + 0.9**2 / 2), rel=1e-6)
    assert torch.equal(found[1:], torch.full((9,), 2.0))
    generator = torch.Generator().manual_seed(1)
    people = torch.randn(400, 10, generator=generator)
    noise = torch.tensor([0.9] + [0.5] * 9)
    errors = {0.0: [], 0.9: []}
    for person in people:
        hands = [person + noise * torch.randn(10, generator=generator) for _ in range(2)]
        for size_error, found in errors.items():
            found.append(float((likely_shape(hands, 0.6, size_error) - person)[0].square()))
    assert np.mean(errors[0.9]) < 0.95 * np.mean(errors[0.0])


@torch.no_grad()
def test_one_hand_keeps_its_own_shape(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    for side in SIDES:
        one = build(replace(tiny, hands={side: tiny.hands[side]}), both_hands, shape_error=0.0).scene
        assert one.entities == (side, "object")
        joints = one.at(torch.arange(len(tiny))).joints(side)
        np.testing.assert_allclose(
            joints.numpy(), initial_trajectory(tiny, both_hands).joints[side], atol=5e-4
        )


@torch.no_grad()
def test_the_object_starts_at_the_estimates(
    scene: Scene, tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    given = initial_trajectory(tiny, both_hands).object_verts
    assert given is not None
    surface = scene.at(torch.arange(len(tiny))).object_points(scene.object_surface.verts).numpy()
    for t in (0, 6):
        distance, _ = cKDTree(surface[t]).query(given[t])
        # A stray point is anywhere; most lie on the surface.
        assert np.median(distance) < 0.004


@torch.no_grad()
def test_start_values_render_where_the_masks_are(scene: Scene, tiny: Clip) -> None:
    canonical = scene.canonical(scene.entities)
    scores: dict[Entity, list[float]] = {entity: [] for entity in scene.entities}
    for t in range(0, len(tiny), 4):
        labels = tiny.mask(t)
        for entity in scene.entities:
            posed = scene.at(torch.tensor([t])).posed({entity: canonical[entity]})
            out = rasterization(*posed, torch.eye(4)[None], scene.K[None], scene.width, scene.height)
            alpha = out.alphas[0, 0, ..., 0].numpy() > 0.5
            own, others = labels == MASK_VALUES[entity], (labels != 0) & (labels != MASK_VALUES[entity])
            # Where another subject may hide it, neither counts.
            union = (alpha | own) & ~others
            scores[entity].append((alpha & own).sum() / union.sum())
    assert np.mean(scores["object"]) > 0.8
    assert min(np.mean(scores["right"]), np.mean(scores["left"])) > 0.4


@torch.no_grad()
def test_the_surface_is_closed_and_near_the_truth(scene: Scene, tiny_clip: Path) -> None:
    truth = load_ground_truth(tiny_clip)
    mesh = trimesh.Trimesh(scene.object_surface.verts.numpy(), scene.object_surface.faces.numpy())
    assert mesh.is_watertight
    assert mesh.volume > 0  # faces look outward
    assert truth.object_verts is not None and truth.object_faces is not None
    true = trimesh.Trimesh(truth.object_verts[0], truth.object_faces)
    # The estimated size is off by some percent.
    assert (mesh.volume / true.volume) ** (1 / 3) == pytest.approx(1.0, abs=0.2)
    # The distance field and the mesh are the same surface.
    assert scene.object_distance(scene.object_surface.verts).abs().max() < 1e-3
    middle = torch.as_tensor(mesh.center_mass, dtype=torch.float32)
    assert scene.object_distance(middle[None]).item() < -0.005


@torch.no_grad()
def test_where_nothing_speaks_for_a_surface(
    scene: Scene, tiny: Clip, both_hands: dict[Side, HandModel]
) -> None:
    """The mesh may end there and, if no symmetry is found, hands meet nothing; the rest is as before."""
    doubtful = replace(AS_GIVEN, surface_solid=0.015, surface_kept=0.03)
    for completion in (None, CompletionConfig(enough=0.0)):  # which finds nothing
        cut = build(tiny, both_hands, initial=doubtful, completion=completion)
        assert torch.equal(cut.scene.object_splats().means, scene.object_splats().means)
        whole = cut.scene.object_surface.verts
        assert torch.equal(whole, scene.object_surface.verts)
        assert cut.known is not None and 0.01 < cut.known.left_out < 0.5
        kept = cut.known.of(cut.scene.object_surface).verts
        gone = ~(whole[:, None] == kept[None]).all(-1).any(1)
        assert 0 < int(gone.sum()) == len(whole) - len(kept)
        field = cut.scene.object_distance
        if completion is None:
            assert torch.equal(field.values, scene.object_distance.values)
        else:
            assert (field(whole[gone]) > 0.005).all()
            assert (field(kept) >= scene.object_distance(kept)).all()
            assert field(kept).abs().median() < 1e-3
    enough = replace(doubtful, surface_guessed=1.0)
    cut = build(tiny, both_hands, initial=enough, completion=CompletionConfig(enough=0.0))
    assert torch.equal(cut.scene.object_distance.values, scene.object_distance.values)


@torch.no_grad()
def test_gaussians_lie_just_below_the_surface(scene: Scene) -> None:
    splats = scene.canonical(["object"])["object"]
    assert 0.7 * SMOKE.object.n_gaussians < len(splats.means) <= SMOKE.object.n_gaussians
    distance = scene.object_distance(splats.means)
    assert distance.abs().max() < 0.01
    assert distance.median() < 0
    assert (splats.offsets == 0).all()  # a fresh field changes nothing
    np.testing.assert_allclose(splats.normals.norm(dim=-1).numpy(), 1.0, atol=1e-5)


def test_colors_come_from_the_points(scene: Scene, tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    assert tiny.object is not None and tiny.object.colors is not None
    with torch.no_grad():
        colors = scene.canonical(["object"])["object"].colors
        grey = build(replace(tiny, object=replace(tiny.object, colors=None)), both_hands).scene
        np.testing.assert_allclose(grey.canonical(["object"])["object"].colors.numpy(), 0.5, atol=1e-5)
    np.testing.assert_allclose(colors.mean(0).numpy(), tiny.object.colors.mean(0), atol=0.06)


def test_building_is_deterministic(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    first, second = (build(tiny, both_hands).scene.state_dict() for _ in range(2))
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


@torch.no_grad()
def test_hands_start_in_the_colour_of_the_pictures(scene: Scene, tiny: Clip) -> None:
    seen = hand_color(tiny)
    assert seen is not None
    torch.testing.assert_close(torch.sigmoid(scene.hand_splats["right"].color), torch.tensor(seen))


def test_without_object_masks_the_points_serve(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    hidden = replace(tiny, mask_areas=tiny.mask_areas | {"object": np.zeros(len(tiny), dtype=int)})
    scene, notes, *_ = build(hidden, both_hands)
    assert len(notes) == 1
    assert notes[0].startswith("object surface from masks: no frame shows the object; using the points'")
    hull = trimesh.Trimesh(scene.object_surface.verts.numpy(), scene.object_surface.faces.numpy())
    assert hull.is_watertight and hull.volume > 0


def test_points_in_a_plane_are_named(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    assert tiny.object is not None
    flat = tiny.object.points * [1.0, 1.0, 0.0]
    with pytest.raises(InputError, match=r"pts\.cano: expected points that span a volume"):
        build(replace(tiny, object=replace(tiny.object, points=flat)), both_hands)


def test_sampling_is_even_and_repeatable() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    points, normals = sample_surface(ball.vertices, ball.faces, 400)
    again, _ = sample_surface(ball.vertices, ball.faces, 400)
    np.testing.assert_array_equal(points, again)
    assert 300 < len(points) <= 400
    np.testing.assert_allclose(normals, points / np.linalg.norm(points, axis=1, keepdims=True), atol=0.15)
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.min() > 0.3 * nearest.mean()
