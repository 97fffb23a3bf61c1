"""What holds free Gaussians where pictures say little."""

from __future__ import annotations

import pytest
import torch

from bigs.models.hand_detail import free_hand
from bigs.models.object_detail import ObjectDetail, split_object
from bigs.models.scene import Scene
from bigs.train.loop.step import Evidence, Selection, Step
from bigs.train.loop.terms import TERMS
from bigs.train.plan.presets import FAST, FULL, PAPER
from bigs.train.switches import without


def loss(name: str, scene: Scene, evidence: Evidence) -> torch.Tensor:
    return TERMS[name](Step(scene, evidence, {}, Selection(torch.arange(scene.n_frames))))


@pytest.fixture
def detail(scene: Scene) -> ObjectDetail:
    """The object of `scene`, freed."""
    with torch.no_grad():
        whole = scene.object_splats()
    scene.object_splats = split_object(whole, 1, 0.0)
    return scene.object_splats


NAMES = ("color_prior", "thickness", "hand_color_prior", "hand_thickness")


def test_a_field_costs_nothing(scene: Scene, evidence: Evidence) -> None:
    assert all(loss(name, scene, evidence) == 0.0 for name in NAMES)


@pytest.mark.usefixtures("detail")
def test_fresh_gaussians_cost_nothing(scene: Scene, evidence: Evidence) -> None:
    scene.hand_splats["right"] = free_hand(scene.hand_splats["right"])
    assert all(loss(name, scene, evidence) == 0.0 for name in NAMES)


def test_hands_have_prices_of_their_own(scene: Scene, evidence: Evidence, detail: ObjectDetail) -> None:
    hand = scene.hand_splats["right"] = free_hand(scene.hand_splats["right"])
    with torch.no_grad():
        hand.color[3], hand.size[4, 2] = torch.tensor([0.0, 2.0, 0.0]), 0.5
        detail.color[0], detail.size[1, 2] = 9.0, 9.0
    count = len(hand.color)
    assert loss("hand_color_prior", scene, evidence).item() == pytest.approx(4.0 / count, rel=1e-6)
    assert loss("hand_thickness", scene, evidence).item() == pytest.approx(0.25 / count, rel=1e-6)


def test_a_change_of_colour_costs_its_square(scene: Scene, evidence: Evidence, detail: ObjectDetail) -> None:
    with torch.no_grad():
        detail.color[0] = torch.tensor([1.0, -2.0, 0.0])
    assert loss("color_prior", scene, evidence).item() == pytest.approx(5.0 / len(detail.color), rel=1e-6)
    assert loss("thickness", scene, evidence) == 0.0


def test_only_growth_across_the_surface_costs(scene: Scene, evidence: Evidence, detail: ObjectDetail) -> None:
    with torch.no_grad():
        detail.size[0] = torch.tensor([3.0, 3.0, -1.0])
    assert loss("thickness", scene, evidence) == 0.0
    with torch.no_grad():
        detail.size[1, 2] = 0.5
    value = loss("thickness", scene, evidence)
    assert value.item() == pytest.approx(0.25 / len(detail.size), rel=1e-6)
    value.backward()
    assert detail.size.grad.nonzero().tolist() == [[1, 2]]


def test_the_third_axis_is_the_one_across_the_surface(scene: Scene, detail: ObjectDetail) -> None:
    """`thickness` relies on it."""
    canonical = detail()
    along = canonical.scales[:, :2].amin(dim=1)
    assert (canonical.scales[:, 2] < along).all()


def test_what_keeps_fields_has_no_terms_of_free_gaussians() -> None:
    for config in (FAST, FULL):
        named = {name for stage in config.stages for name in getattr(stage, "weights", {})}
        assert {"color_prior", "thickness"} <= named
        fields = without(config, "split")
        assert not set(NAMES) & {name for stage in fields.stages for name in getattr(stage, "weights", {})}
    assert without(PAPER, "split") == PAPER
