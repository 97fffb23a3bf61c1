"""Light on a Gaussian's third axis: neutral at the start, positive always, differentiable."""

import pytest
import torch
from posing_twin import quadratic_basis, third_axis

from bigs.fused.posing import Posing, pose
from bigs.geometry.rotations import quat_to_matrix
from bigs.models.lighting import Lighting
from bigs.types import Gaussians

B, N = 3, 8


def gaussians(dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    return Gaussians(
        random(B, N, 3), random(B, N, 4) - 0.5, random(N, 3), random(N), 0.1 + 0.8 * random(N, 3)
    )


def light(given: Gaussians, clip, shade, parts=None) -> torch.Tensor:
    """Colours [B, N, 3] of Gaussians that stand still, each frame with quaternions of its own."""
    still = torch.eye(4, dtype=given.means.dtype)[None, None]
    parts = given.means.new_zeros(given.means.shape[1], 0) if parts is None else parts
    one = given.means.new_ones(given.means.shape[1], 1)
    lit = [
        pose([Posing(means, one, still, quats, given.colors, parts, own)], clip, False)
        for means, quats, own in zip(given.means, given.quats, shade[:, None], strict=True)
    ]
    for (means, quats, _), own_means, own_quats in zip(lit, given.means, given.quats, strict=True):
        assert torch.equal(means[0], own_means) and torch.equal(quats[0], own_quats)
    return torch.cat([colors for _, _, colors in lit])


def test_third_axis_is_the_rotations_third_column() -> None:
    quats = torch.randn(50, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(third_axis(quats), quat_to_matrix(quats)[..., 2])
    torch.testing.assert_close(third_axis(-0.01 * quats), quat_to_matrix(quats)[..., 2])


def test_without_coefficients_colours_are_the_albedo() -> None:
    given = gaussians()
    lit = light(given, torch.zeros(8, 3), torch.zeros(B, 4))
    assert torch.equal(lit, given.colors.expand(B, N, 3))
    fresh = Lighting(["object"], 5)
    assert torch.equal(light(given, fresh.clip, fresh.shade["object"][[0, 4, 2]], torch.rand(N, 16)), lit)


def test_light_by_hand() -> None:
    """One Gaussian that faces +y in frame 0 and -z in frame 1."""
    half = 0.5**0.5
    quats = torch.tensor([[[half, -half, 0.0, 0.0]], [[0.0, 1.0, 0.0, 0.0]]])
    torch.testing.assert_close(third_axis(quats)[:, 0], torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]))
    given = Gaussians(torch.zeros(2, 1, 3), quats, torch.ones(1, 3), torch.ones(1), torch.full((1, 3), 0.5))
    clip = torch.zeros(8, 3)
    clip[1, 0], clip[2, 1], clip[7, 2] = 0.3, 0.4, 0.1  # red by y, green by z, blue by 3 z^2 - 1
    shade = torch.tensor([[0.2, 0.0, 0.5, 0.0], [0.0, 9.0, 9.0, -0.7]])
    exponents = torch.tensor([[0.3, 0.0, -0.1], [0.0, -0.4, 0.2]]) + torch.tensor([[0.7], [0.7]])
    torch.testing.assert_close(light(given, clip, shade)[:, 0], 0.5 * exponents.exp())


def test_parts_have_a_shade_of_their_own() -> None:
    """Gaussian 0 belongs to part 2, Gaussian 1 to parts 2 and 5 alike; frame 1 darkens part 2 alone."""
    given = gaussians()
    weights = torch.zeros(N, 16)
    weights[0, 2] = 1.0
    weights[1, 2] = weights[1, 5] = 0.5
    lighting = Lighting(["right"], B)
    with torch.no_grad():
        lighting.shade["right"][1, 4 + 2] = -0.4
    ratio = light(given, lighting.clip, lighting.shade["right"], weights) / given.colors
    torch.testing.assert_close(ratio[1, 0], torch.full((3,), -0.4).exp())
    torch.testing.assert_close(ratio[1, 1], torch.full((3,), -0.2).exp())
    assert (ratio[1, 2:] == 1).all() and (ratio[[0, 2]] == 1).all()


def test_light_is_positive_and_keeps_black_black() -> None:
    given = gaussians()
    generator = torch.Generator().manual_seed(2)
    lit = light(given, 5.0 * torch.randn(8, 3, generator=generator), torch.randn(B, 4, generator=generator))
    assert (lit > 0).all() and lit.isfinite().all()
    assert lit.std() > 0.1
    black = given._replace(colors=torch.zeros(N, 3))
    assert not light(black, torch.ones(8, 3), torch.ones(B, 4)).any()


def test_the_basis_has_no_constant_and_is_orthogonal_over_the_sphere() -> None:
    """A constant would be the albedo's; correlated functions would learn at odd rates."""
    count = 4000
    z = 1.0 - (2.0 * torch.arange(count).double() + 1.0) / count
    turn = torch.pi * (3.0 - 5.0**0.5) * torch.arange(count).double()
    flat = (1.0 - z * z).sqrt()
    basis = quadratic_basis(torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=-1))
    assert basis.mean(0).abs().max() < 1e-3
    gram = basis.T @ basis / count
    assert (gram - torch.diag(gram.diag())).abs().max() < 2e-3
    assert gram.diag().min() > 0.05


def test_each_entity_and_frame_has_its_own_shade() -> None:
    lighting, given = Lighting(["right", "object"], 5), gaussians()
    with torch.no_grad():
        lighting.shade["object"][4, 0] = 1.0
    frames = torch.tensor([0, 4, 2])

    def colors(entity: str, parts: torch.Tensor) -> torch.Tensor:
        return light(given, lighting.clip, lighting.shade[entity][frames], parts)

    lit = colors("object", torch.zeros(N, 16)) / given.colors
    torch.testing.assert_close(lit[1], torch.full((N, 3), torch.e))
    assert (lit[[0, 2]] == 1).all()
    assert (colors("right", torch.rand(N, 16)) == given.colors).all()
    colors("object", torch.zeros(N, 16)).sum().backward()
    assert lighting.shade["object"].grad.abs().sum(1).nonzero()[:, 0].tolist() == [0, 2, 4]
    assert lighting.shade["right"].grad is None


@pytest.mark.parametrize("zero", [True, False])
@pytest.mark.parametrize("parts", [0, 3])
def test_gradients(zero: bool, parts: int) -> None:
    given = gaussians(torch.float64)
    generator = torch.Generator().manual_seed(3)
    clip, shade = (
        torch.randn(*s, generator=generator, dtype=torch.float64) for s in ((8, 3), (B, 4 + parts))
    )
    weights = torch.rand(N, parts, generator=generator, dtype=torch.float64)
    if zero:
        clip, shade = torch.zeros_like(clip), torch.zeros_like(shade)

    def colors(quats, albedo, clip, shade):
        return light(given._replace(quats=quats, colors=albedo), clip, shade, weights)

    inputs = [x.clone().requires_grad_() for x in (given.quats, given.colors, clip, shade)]
    assert torch.autograd.gradcheck(colors, inputs)
