import pytest
import torch

from bigs.losses.mask import (
    alpha_outside_masks,
    amodal_silhouette,
    label_difference,
    outside_mask,
    outside_mask_on,
)


def images(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_spilled_pixel_costs_the_same_however_much_is_empty() -> None:
    foreground = torch.zeros(60)
    foreground[:10] = 1.0
    inside, outside = torch.zeros(60, 1), torch.zeros(60, 1)
    inside[4], outside[40] = 0.5, 0.5
    assert alpha_outside_masks(outside, 1.0 - foreground, foreground) == pytest.approx(0.5**2 / 10)
    assert alpha_outside_masks(outside[:45], (1.0 - foreground)[:45], foreground) == pytest.approx(
        0.5**2 / 10
    )
    assert alpha_outside_masks(inside, 1.0 - foreground, foreground) == 0.0
    assert alpha_outside_masks(outside, torch.zeros(60), foreground) == 0.0


def test_outside_mask_sees_only_the_outside() -> None:
    pred = images(2, 4, 5, 3)
    foreground = torch.zeros(2, 4, 5)
    foreground[:, :, :3] = 1.0
    assert outside_mask(pred, foreground).item() == pytest.approx(pred[:, :, 3:].mean().item())
    assert outside_mask(pred, torch.ones(2, 4, 5)) == 0.0
    pred[:, :, 3:] = 0.0
    assert outside_mask(pred, foreground) == 0.0


def test_a_random_background_is_as_if_rendered_over_it() -> None:
    """Eq. 5's regulariser on C + (1 - A) b, whose empty pixels are b and must cost nothing."""
    alphas, own = images(2, 4, 5, 1, seed=1).float(), images(2, 4, 5, 3).float()
    alphas[0, :2] = 0.0
    foreground = (images(2, 4, 5, seed=2) > 0.5).float()
    b = torch.rand(3, generator=torch.Generator().manual_seed(7))
    over = alphas * own + (1 - alphas) * b
    expected = outside_mask(over - b, foreground)
    found = outside_mask_on(alphas * own, alphas, foreground, torch.Generator().manual_seed(7))
    torch.testing.assert_close(found, expected)
    # A black Gaussian hides on black only.
    black = torch.zeros(2, 4, 5, 3)
    assert outside_mask(black, foreground) == 0.0
    assert outside_mask_on(black, alphas, foreground, torch.Generator().manual_seed(7)) > 0.05
    assert outside_mask_on(black, 0 * alphas, foreground, torch.Generator().manual_seed(7)) == 0.0


def test_amodal_silhouette_by_hand() -> None:
    # One row of pixels: own, own but empty, hidden, background with a spill, partly own and partly hidden.
    alpha = torch.tensor([[[1.0, 0.2, 0.6, 0.5, 0.9]]])
    own = torch.tensor([[[1.0, 1.0, 0.0, 0.0, 0.25]]])
    hidden = torch.tensor([[[0.0, 0.0, 1.0, 0.0, 0.5]]])
    expected = (0.8**2 + 0.5**2 + 0.15**2) / own.sum()
    assert amodal_silhouette(alpha, own, hidden).item() == pytest.approx(expected.item())


def test_where_others_may_hide_it_the_silhouette_is_free() -> None:
    own = torch.zeros(1, 6, 6, dtype=torch.float64)
    own[:, :, :2] = 1.0
    hidden = torch.zeros_like(own)
    hidden[:, :, 2:4] = 1.0
    alpha = (0.05 + 0.9 * images(1, 6, 6)).requires_grad_()
    amodal_silhouette(alpha, own, hidden).backward()
    assert torch.equal(alpha.grad[:, :, 2:4], torch.zeros(1, 6, 2).double())
    assert (alpha.grad[:, :, :2] < 0).all()  # where it must show, more is better
    assert (alpha.grad[:, :, 4:] > 0).all()  # over background, less is


def test_an_exact_silhouette_costs_nothing() -> None:
    own = images(2, 5, 5)
    assert amodal_silhouette(own, own, 0.5 * (1.0 - own)) == 0.0


def test_labels_by_hand() -> None:
    pred, labels = torch.zeros(1, 2, 2, 3), torch.zeros(1, 2, 2, 3)
    labels[0, 0, :, 1] = 1.0
    pred[0, 0, 0, 1], pred[0, 0, 1, 2] = 1.0, 0.5  # right; and the wrong subject in front
    assert label_difference(pred, labels).item() == pytest.approx((1.0 + 0.25) / 2.0)
    assert label_difference(labels, labels) == 0.0


def test_empty_masks_divide_by_no_zero() -> None:
    alpha, empty = images(1, 3, 3), torch.zeros(1, 3, 3)
    assert amodal_silhouette(alpha, empty, empty).item() == pytest.approx(alpha.square().sum().item())
    assert label_difference(alpha[..., None], empty[..., None]).isfinite()


def test_gradients() -> None:
    alpha, own, hidden = images(3, 2, 4, 4)
    pred, labels = images(2, 2, 4, 4, 3, seed=1)
    assert torch.autograd.gradcheck(lambda a: amodal_silhouette(a, own, hidden), alpha.requires_grad_())
    assert torch.autograd.gradcheck(lambda p: outside_mask(p, own), pred.clone().requires_grad_())
    assert torch.autograd.gradcheck(lambda p: label_difference(p, labels), pred.requires_grad_())
