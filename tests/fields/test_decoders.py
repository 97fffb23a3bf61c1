"""Fresh decoders reproduce their start; trained ones stay within their bounds."""

import pytest
import torch

from bigs.fields.decoders import AppearanceDecoder, GeometryDecoder, SkinningDecoder

N, F = 7, 6


@pytest.fixture
def features() -> torch.Tensor:
    return torch.randn(N, F, generator=torch.Generator().manual_seed(0))


def disturb(decoder: torch.nn.Module, amount: float = 5.0) -> None:
    """Move every parameter far from its start."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter += amount * torch.randn(parameter.shape, generator=generator)


def test_fresh_appearance_is_its_start(features) -> None:
    colors = torch.linspace(0.02, 0.98, 3 * N).reshape(N, 3)
    opacities = torch.linspace(0.1, 0.95, N)
    fresh = AppearanceDecoder(F, 8)(features, torch.logit(colors), torch.logit(opacities))
    assert torch.equal(fresh.colors, torch.sigmoid(torch.logit(colors)))
    assert torch.equal(fresh.opacities, torch.sigmoid(torch.logit(opacities)))
    torch.testing.assert_close(fresh.colors, colors)
    torch.testing.assert_close(fresh.opacities, opacities)


def test_fresh_geometry_changes_nothing(features) -> None:
    fresh = GeometryDecoder(F, 8, max_offset=0.003)(features)
    assert torch.equal(fresh.offsets, torch.zeros(N, 3))
    assert torch.equal(fresh.rotations, torch.eye(3).expand(N, 3, 3))
    assert torch.equal(fresh.log_scales, torch.zeros(N, 3))


def test_fresh_skinning_is_its_start_up_to_the_floor_under_the_logarithm(features) -> None:
    start = torch.zeros(N, 16)
    start[torch.arange(N), torch.arange(N)] = 0.7
    start[:, 15] += 0.3
    weights = SkinningDecoder(F, 8)(features, start)
    torch.testing.assert_close(weights, (start + 1e-4) / (1.0 + 16e-4))
    torch.testing.assert_close(weights, start, atol=1.6e-3, rtol=0)


def test_disturbed_decoders_stay_within_their_bounds(features) -> None:
    appearance = AppearanceDecoder(F, 8)
    disturb(appearance)
    shown = appearance(features, torch.zeros(N, 3), torch.zeros(N))
    assert shown.colors.shape == (N, 3) and shown.opacities.shape == (N,)
    for values in shown:
        assert ((values >= 0) & (values <= 1)).all()
        assert (values - 0.5).abs().max() > 0.1
    geometry = GeometryDecoder(F, 8, max_offset=0.003, max_log_scale=0.5)
    disturb(geometry)
    moved = geometry(features)
    assert 0.001 < moved.offsets.abs().max() <= 0.003
    assert 0.1 < moved.log_scales.abs().max() <= 0.5
    torch.testing.assert_close(moved.rotations @ moved.rotations.mT, torch.eye(3).expand(N, 3, 3))
    torch.testing.assert_close(torch.linalg.det(moved.rotations), torch.ones(N))


def test_skinning_rows_sum_to_one_wherever_the_field_goes(features) -> None:
    start = torch.softmax(torch.randn(N, 16, generator=torch.Generator().manual_seed(2)), dim=-1)
    decoder = SkinningDecoder(F, 8)
    disturb(decoder, 1.0)
    weights = decoder(features, start)
    torch.testing.assert_close(weights.sum(-1), torch.ones(N))
    assert (weights >= 0).all() and (weights - start).abs().max() > 0.1


@pytest.mark.parametrize("decoder", [AppearanceDecoder(F, 8), GeometryDecoder(F, 8, 0.003)])
def test_every_head_learns_from_the_first_step(features, decoder) -> None:
    starts = (torch.zeros(N, 3), torch.zeros(N)) if isinstance(decoder, AppearanceDecoder) else ()
    generator = torch.Generator().manual_seed(3)
    out = decoder(features, *starts)
    sum((value * torch.randn(value.shape, generator=generator)).sum() for value in out).backward()
    heads = {name: p for name, p in decoder.named_parameters() if not name.startswith("trunk")}
    assert heads and all(p.grad.abs().max() > 0 for p in heads.values())


def test_gradients_of_a_disturbed_geometry(features) -> None:
    decoder = GeometryDecoder(F, 4, max_offset=0.3).double()
    disturb(decoder, 0.3)
    assert torch.autograd.gradcheck(decoder, features[:2].double().requires_grad_())


@pytest.mark.parametrize("decoder", [GeometryDecoder(F, 8, 0.003), SkinningDecoder(F, 8)])
def test_a_fresh_decoder_that_does_not_learn_gives_the_same_without_its_network(
    features, decoder, monkeypatch
) -> None:
    starts = (torch.full((N, 16), 1 / 16),) if isinstance(decoder, SkinningDecoder) else ()
    worked = decoder(features, *starts)
    decoder.requires_grad_(False)
    monkeypatch.setattr(decoder.trunk, "forward", None)  # fails if called
    idle = decoder(features, *starts)
    for a, b in zip(*(((v,) if torch.is_tensor(v) else v) for v in (worked, idle)), strict=True):
        assert torch.equal(a, b) and not b.requires_grad
    disturb(decoder)
    with pytest.raises(TypeError):
        decoder(features, *starts)
