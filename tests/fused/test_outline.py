"""What a mesh covers: compiled against samples in every triangle, areas known by hand, and differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bigs.fused.outline import covered_shares
from bigs.hand import HandModel
from bigs.types import Side

WIDTH, HEIGHT = 50, 40
K = torch.tensor([[60.0, 1.5, 25.0], [0.0, 55.0, 20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
# Samples in a pixel, down and across.
SAMPLES = 4, 8


def at(*places: tuple[float, float], depth: float = 0.5) -> Tensor:
    """Points [1, N, 3] that are seen at these places of the picture, pixels."""
    ends = torch.tensor([[x, y, 1.0] for x, y in places], dtype=torch.float64)
    return depth * (ends @ torch.linalg.inv(K).T)[None]


def covered(points: Tensor, faces: Tensor) -> Tensor:
    return covered_shares(points, faces, K.to(points), WIDTH, HEIGHT)


def twin(points: Tensor, faces: Tensor) -> np.ndarray:
    """The same for one frame [H, W], by asking for every sample whether it is in any triangle."""
    down, across = SAMPLES
    pixels = points.double().numpy() @ K.numpy().T
    corners = pixels[:, :2] / pixels[:, 2:]
    y, x = np.mgrid[: down * HEIGHT, : across * WIDTH]
    samples = np.stack([(x + 0.5) / across, (y + 0.5) / down], axis=-1)
    inside = np.zeros(x.shape, dtype=bool)
    for a, b, c in corners[faces.numpy()]:

        def side(p: np.ndarray, q: np.ndarray) -> np.ndarray:
            return (q[0] - p[0]) * (samples[..., 1] - p[1]) - (q[1] - p[1]) * (samples[..., 0] - p[0])

        turns = np.stack([side(a, b), side(b, c), side(c, a)])
        inside |= (turns >= 0).all(0) | (turns <= 0).all(0)
    return inside.reshape(HEIGHT, down, WIDTH, across).mean((1, 3))


def posed_hand(model: HandModel, count: int = 2) -> Tensor:
    """Vertices [B, V, 3] of hands that turn, partly beyond the picture's border."""
    points = (model.v_template - model.v_template.mean(0)).double()
    frames = []
    for frame in range(count):
        angle = torch.tensor(0.7 * frame + 0.3, dtype=torch.float64)
        turn = torch.eye(3, dtype=torch.float64)
        turn[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
        frames.append(points @ turn.T + torch.tensor([0.03 * frame, 0.01, 0.3], dtype=torch.float64))
    return torch.stack(frames)


def test_shares_are_those_of_every_sample_in_every_triangle(both_hands: dict[Side, HandModel]) -> None:
    points = posed_hand(both_hands["right"])
    shares = covered(points, both_hands["right"].faces)
    assert 100 < float(shares[0].sum()) < 1500
    for frame in range(len(points)):
        expected = twin(points[frame], both_hands["right"].faces)
        # A sample on a border may belong to either side.
        np.testing.assert_allclose(shares[frame], expected, atol=1 / 32)
        assert float((shares[frame].numpy() - expected).mean()) < 1e-4
    turned_over = both_hands["right"].faces.flip(-1)
    assert torch.equal(covered(points, turned_over), shares)
    single = covered(points.float(), both_hands["right"].faces)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), shares, atol=1 / 16, rtol=0)


def area_and_gradient(places: list[tuple[float, float]], faces: list[list[int]]) -> tuple[float, Tensor]:
    points = at(*places).requires_grad_()
    area = covered(points, torch.tensor(faces)).sum()
    area.backward()
    return area.item(), points.grad[0]


def test_the_area_of_a_triangle_changes_as_it_should() -> None:
    places = [(10.0, 8.0), (41.0, 12.0), (18.0, 33.0)]
    area, gradient = area_and_gradient(places, [[0, 1, 2]])
    flat = torch.tensor(places, dtype=torch.float64, requires_grad=True)
    (a, b, c) = flat
    true = (
        0.5
        * torch.linalg.cross(torch.cat([b - a, torch.zeros(1)]), torch.cat([c - a, torch.zeros(1)]), dim=0)[
            2
        ].abs()
    )
    true.backward()
    assert area == pytest.approx(true.item(), rel=0.01)
    seen = at(*places).requires_grad_()
    pixels = seen @ K.T
    (pixels[..., :2] / pixels[..., 2:]).backward(flat.grad[None])
    torch.testing.assert_close(gradient, seen.grad[0], rtol=1e-9, atol=1e-9)


def test_what_something_else_covers_moves_nothing() -> None:
    around = [(5.0, 5.0), (45.0, 5.0), (25.0, 38.0)]
    _, gradient = area_and_gradient(
        [*around, (22.0, 12.0), (28.0, 12.0), (25.0, 18.0)], [[0, 1, 2], [3, 4, 5]]
    )
    assert (gradient[3:] == 0).all() and (gradient[:3] != 0).any()
    # An edge between two triangles ends nothing.
    square = [(10.0, 10.0), (30.0, 10.0), (30.0, 30.0), (10.0, 30.0)]
    area, gradient = area_and_gradient(square, [[0, 1, 2], [0, 2, 3]])
    assert area == pytest.approx(400.0, rel=0.01)
    other_way = area_and_gradient(square, [[0, 1, 3], [1, 2, 3]])[1]
    torch.testing.assert_close(gradient, other_way)


@pytest.mark.parametrize("direction", ["along x", "nearer", "wider"])
def test_gradients_are_differences_of_a_smooth_sum(both_hands: dict[Side, HandModel], direction: str) -> None:
    points = posed_hand(both_hands["right"], 1)
    y, x = torch.meshgrid(
        torch.arange(HEIGHT, dtype=torch.float64), torch.arange(WIDTH, dtype=torch.float64), indexing="ij"
    )
    weights = 0.02 * x + torch.sin(y / 9.0)
    way = {
        "along x": torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand_as(points),
        "nearer": torch.tensor([0.0, 0.0, -2.0], dtype=torch.float64).expand_as(points),
        "wider": (points - points.mean(1, keepdim=True)) * torch.tensor([20.0, 0.0, 0.0]),
    }[direction]

    def loss(step: float) -> Tensor:
        return (covered(points + step * way, both_hands["right"].faces) * weights).sum()

    moving = points.clone().requires_grad_()
    (covered(moving, both_hands["right"].faces) * weights).sum().backward()
    # About a pixel either way, over which samples average. Pulls from both sides of a hand nearly cancel.
    step = 5e-3
    difference = (loss(step) - loss(-step)).item() / (2 * step)
    pulls = moving.grad * way
    assert pulls.sum().item() == pytest.approx(difference, abs=0.02 * pulls.abs().sum().item())


def test_what_reaches_behind_the_camera_is_not_seen() -> None:
    points = at((10.0, 10.0), (30.0, 10.0), (20.0, 30.0))
    points[0, 2, 2] = -0.1
    points.requires_grad_()
    shares = covered(points, torch.tensor([[0, 1, 2]]))
    shares.sum().backward()
    assert (shares == 0).all() and (points.grad == 0).all()
    far_aside = at((1e7, 10.0), (30.0, 1e7), (-1e7, -1e7)).requires_grad_()
    shares = covered(far_aside, torch.tensor([[0, 1, 2]]))
    shares.sum().backward()
    assert far_aside.grad.isfinite().all()


def test_nothing_covers_nothing() -> None:
    points = at((10.0, 10.0)).requires_grad_()
    shares = covered(points, torch.zeros(0, 3, dtype=torch.long))
    shares.sum().backward()
    assert shares.shape == (1, HEIGHT, WIDTH) and not shares.any() and not points.grad.any()
    assert covered(points[:0], torch.zeros(0, 3, dtype=torch.long)).shape == (0, HEIGHT, WIDTH)


def test_refusals() -> None:
    points = at((10.0, 10.0), (30.0, 10.0), (20.0, 30.0))
    face = torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match="faces: expected indices of vertices, found 3"):
        covered(points, torch.tensor([[0, 1, 3]]))
    with pytest.raises(ValueError, match="faces: expected indices of vertices, found -1"):
        covered(points, torch.tensor([[0, 1, -1]]))
    points[0, 1, 2] = float("nan")
    with pytest.raises(ValueError, match="points: expected finite values"):
        covered(points, face)
