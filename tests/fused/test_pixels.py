"""Terms of pictures in one pass against the losses they are made of, and their gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bigs.fused.pixels import AloneTerms, TogetherTerms, alone_terms, coverage_squares, together_terms
from bigs.losses.mask import alpha_outside_masks, amodal_silhouette, label_difference
from bigs.losses.photometric import masked_l1, masked_mse

T, H, W, E = 5, 9, 13, 2
FRAMES = torch.tensor([0, 3, 4])
COVERED = 0.5


def random(seed: int, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def clip() -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    """Images, foreground, unknown and shares, with pixels of every kind."""
    shares = [random(10 + e, T, H, W) * (random(20 + e, T, H, W) > 0.6) / E for e in range(E)]
    unknown = random(30, T, H, W) * (random(31, T, H, W) > 0.7)
    return random(1, T, H, W, 3), sum(shares).clamp(max=1.0), unknown, shares


def rendered(channels: int) -> tuple[Tensor, Tensor]:
    alphas = random(2, len(FRAMES), H, W, 1) * (random(3, len(FRAMES), H, W, 1) > 0.4)
    colors = random(4, len(FRAMES), H, W, channels) * (alphas > 0)
    return colors.requires_grad_(), alphas.requires_grad_()


def together_twin(colors, alphas, images, foreground, unknown, shares, frames, covered) -> TogetherTerms:
    foreground, unknown = foreground[frames], unknown[frames]
    counts = ((foreground > 0) | (alphas[..., 0] > 0)) & (unknown <= covered)
    colors, alphas, images = colors[counts], alphas[counts], images[frames][counts]
    foreground, unknown = foreground[counts], unknown[counts]
    empty = (1.0 - foreground - unknown).clamp_min(0.0)
    return TogetherTerms(
        masked_l1(colors[:, :3], images, foreground),
        masked_mse(colors[:, :3], images, foreground),
        alpha_outside_masks(alphas, empty, foreground),
        label_difference(colors[:, 3:], torch.stack([share[frames][counts] for share in shares], -1))
        if shares
        else colors.new_zeros(()),
    )


def alone_twin(colors, alphas, images, own, hidden, frames) -> AloneTerms:
    own, hidden, images = own[frames], hidden[frames], images[frames]
    return AloneTerms(
        masked_l1(colors, images, own),
        masked_mse(colors, images, own),
        amodal_silhouette(alphas[..., 0], own, hidden),
    )


def check(found, expected, inputs: tuple[Tensor, ...]) -> None:
    weights = torch.tensor([0.7, 3.0, 1.3, 0.4], dtype=torch.float64)[: len(found)]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-14, rtol=1e-12)
    gradients = [
        torch.autograd.grad(sum(w * term for w, term in zip(weights, terms, strict=True)), inputs)
        for terms in (found, expected)
    ]
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-14, rtol=1e-12)
        assert a.any()


@pytest.mark.parametrize("labels", [False, True])
def test_together_is_the_losses(labels: bool) -> None:
    images, foreground, unknown, shares = clip()
    shares = shares if labels else []
    colors, alphas = rendered(3 + len(shares))
    call = colors, alphas, images, foreground, unknown, shares, FRAMES, COVERED
    check(together_terms(*call), together_twin(*call), (colors, alphas))


def test_alone_is_the_losses() -> None:
    images, _, unknown, shares = clip()
    colors, alphas = rendered(3)
    call = colors, alphas, images, shares[0], unknown, FRAMES
    found = alone_terms(*call)
    check(found, alone_twin(*call), (colors, alphas))
    outline = alone_terms(None, *call[1:])
    assert torch.equal(outline.coverage, found.coverage) and outline.image == outline.mse == 0.0
    (alone,) = torch.autograd.grad(outline.coverage, alphas)
    (whole,) = torch.autograd.grad(alone_terms(*call).coverage, alphas)
    assert torch.equal(alone, whole)


def test_coverage_of_each_picture_is_what_the_loss_sums() -> None:
    _, _, unknown, shares = clip()
    alphas = rendered(3)[1].detach()[..., 0].requires_grad_()
    # Frames may repeat: several poses are tried in one.
    frames = torch.tensor([3, 0, 3])
    found = coverage_squares(alphas, shares[0], unknown, frames)
    expected = torch.stack(
        [
            amodal_silhouette(alpha[None], shares[0][frame, None], unknown[frame, None])
            * shares[0][frame].sum().clamp_min(1.0)
            for alpha, frame in zip(alphas, frames, strict=True)
        ]
    )
    check(found, expected, (alphas,))
    single = coverage_squares(*(values.detach().float() for values in (alphas, shares[0], unknown)), frames)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), found.detach(), rtol=1e-6, atol=0)
    assert len(coverage_squares(alphas[:0], shares[0], unknown, frames[:0])) == 0


def test_gradients_are_finite_differences() -> None:
    images, foreground, unknown, shares = clip()
    colors, alphas = rendered(3 + E)
    clipped = images, foreground, unknown, shares, FRAMES, COVERED
    assert torch.autograd.gradcheck(
        lambda c, a: tuple(together_terms(c, a, *clipped)), (colors, (0.1 + alphas).detach().requires_grad_())
    )
    colors, alphas = rendered(3)
    call = images, shares[0], 0.5 * unknown, FRAMES
    assert torch.autograd.gradcheck(lambda c, a: tuple(alone_terms(c, a, *call)), (colors, alphas))


def test_single_precision_sums_as_double_does() -> None:
    images, _, unknown, shares = clip()
    colors, alphas = (values.detach() for values in rendered(3))
    call = colors, alphas, images, shares[0], unknown
    single = alone_terms(*(values.float() for values in call), FRAMES)
    for a, b in zip(single, alone_terms(*call, FRAMES), strict=True):
        assert a.dtype == torch.float32
        assert float(a) == pytest.approx(float(b), rel=1e-6)


def test_nothing_to_see_costs_nothing() -> None:
    images, _, _, shares = clip()
    nothing = torch.zeros(T, H, W, dtype=torch.float64)
    colors, alphas = (torch.zeros(len(FRAMES), H, W, d, dtype=torch.float64) for d in (3, 1))
    assert not any(together_terms(colors, alphas, images, nothing, nothing, [], FRAMES, COVERED))
    assert not any(alone_terms(colors, alphas, images, nothing, shares[0], FRAMES))


def test_what_does_not_fit_is_refused() -> None:
    images, foreground, unknown, shares = clip()
    colors, alphas = rendered(3)
    with pytest.raises(ValueError, match="colors: expected 5"):
        together_terms(colors, alphas, images, foreground, unknown, shares, FRAMES, COVERED)
    with pytest.raises(ValueError, match="frames: expected indices"):
        alone_terms(colors, alphas, images, foreground, unknown, torch.tensor([0, 1, T]))
    with pytest.raises(ValueError, match="alphas: expected"):
        alone_terms(colors, alphas[:2], images, foreground, unknown, FRAMES)
    with pytest.raises(ValueError, match="frames: expected indices"):
        coverage_squares(alphas[..., 0], foreground, unknown, torch.tensor([0, 1, T]))
    with pytest.raises(ValueError, match="alphas: expected"):
        coverage_squares(alphas[:2, ..., 0], foreground, unknown, FRAMES)
    with pytest.raises(ValueError, match="hidden: expected"):
        coverage_squares(alphas[..., 0], foreground, unknown[:3], FRAMES)
    with pytest.raises(ValueError, match="unknown: expected"):
        together_terms(colors, alphas, images, foreground, unknown[:3], [], FRAMES, COVERED)
