"""The photometric terms and the regularisers, whose values are means of simple expressions."""

import pytest
import torch

from bigs.losses.photometric import masked_l1, masked_mse, masked_ssim
from bigs.losses.regularizers import (
    color_spread,
    lbs_deviation,
    scale_size,
    squared_norm,
)
from bigs.losses.weighted import mean_of, weighted_sum


def images(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture
def mask() -> torch.Tensor:
    mask = torch.zeros(2, 16, 16, dtype=torch.float64)
    mask[:, 4:12, 3:9] = 1.0
    mask[:, 12, 3:9] = 0.25
    return mask


def test_masked_l1_is_the_mean_over_the_mask(mask) -> None:
    target = images(2, 16, 16, 3)
    assert masked_l1(target + 0.125, target, mask).item() == pytest.approx(0.125)
    pred = target + torch.where(mask[..., None] > 0, 0.0, 0.7)
    assert masked_l1(pred, target, mask) == 0.0
    assert masked_l1(pred, target, torch.zeros_like(mask)) == 0.0


def test_masked_mse_is_what_psnr_measures_inside_the_mask(mask) -> None:
    target = images(2, 16, 16, 3)
    assert masked_mse(target + 0.5, target, mask).item() == pytest.approx(0.25)
    assert masked_mse(target + torch.where(mask[..., None] > 0, 0.0, 0.7), target, mask) == 0.0
    one = target.clone()
    one[0, 5, 5, 1] += 1.0  # of (48 + 1.5) pixels in each of two images
    assert masked_mse(one, target, mask).item() == pytest.approx(1.0 / (2 * (8 * 6 + 6 / 4) * 3))
    assert masked_mse(one, target, torch.zeros_like(mask)) == 0.0


def test_masked_ssim_is_zero_for_equal_masked_images_and_grows_with_damage(mask) -> None:
    target = images(2, 16, 16, 3)
    elsewhere = target + torch.where(mask[..., None] > 0, 0.0, 0.7)
    assert masked_ssim(elsewhere, target, mask).item() == pytest.approx(0.0, abs=1e-12)
    other = images(2, 16, 16, 3, seed=1)
    little, much = (masked_ssim(target + a * (other - target), target, mask).item() for a in (0.1, 0.8))
    assert 0.0 < little < much < 2.0


def test_masked_ssim_agrees_on_channels_last_with_the_metric(mask) -> None:
    """An image that differs in one channel alone: swapped axes would change the value."""
    from bigs.metrics.image import ssim

    target, pred = images(2, 16, 16, 3), images(2, 16, 16, 3)
    pred[..., 1] = images(2, 16, 16, seed=5)
    first = [image.permute(0, 3, 1, 2) * mask[:, None] for image in (pred, target)]
    torch.testing.assert_close(masked_ssim(pred, target, mask), 1.0 - ssim(*first))


def test_color_spread_is_the_mean_distance_from_the_mean() -> None:
    colors = torch.tensor([[0.0, 0.5, 0.2], [1.0, 0.5, 0.4]])
    assert color_spread(colors).item() == pytest.approx(0.5 + 0.0 + 0.1)
    assert color_spread(torch.full((9, 3), 0.25)) == 0.0


def test_scale_size_is_the_mean_squared_deviation_over_all_axes() -> None:
    scales = torch.tensor([[0.01, 0.02, 0.0], [0.03, 0.0, 0.0]])
    assert scale_size(scales).item() == pytest.approx((1e-4 + 4e-4 + 9e-4) / 2)


def test_lbs_deviation_is_a_squared_frobenius_distance_per_gaussian() -> None:
    weights, target = torch.zeros(4, 16), torch.zeros(4, 16)
    weights[0, 3], target[2, 5] = 0.5, 0.1
    assert lbs_deviation(weights, target).item() == pytest.approx((0.25 + 0.01) / 4)


def test_squared_norm_is_a_mean_over_vectors() -> None:
    assert squared_norm(torch.tensor([[[3.0, 4.0]], [[0.0, 1.0]]])).item() == pytest.approx(13.0)


def test_weighted_sum_adds_and_ignores_weights_without_terms() -> None:
    terms = {"a": torch.tensor(2.0, requires_grad=True), "b": torch.tensor(3.0)}
    total = weighted_sum(terms, {"a": 0.5, "b": 10.0, "later": 7.0})
    assert total.item() == 31.0
    total.backward()
    assert terms["a"].grad == 0.5


def test_a_term_without_weight_is_an_error() -> None:
    with pytest.raises(KeyError, match="b"):
        weighted_sum({"a": torch.tensor(1.0), "b": torch.tensor(1.0)}, {"a": 1.0})


def test_gradients(mask) -> None:
    target = images(1, 6, 6, 3)
    pred, small = images(1, 6, 6, 3, seed=1).requires_grad_(), mask[:1, 7:13, 2:8]
    assert torch.autograd.gradcheck(lambda p: masked_l1(p, target, small), pred)
    assert torch.autograd.gradcheck(lambda p: masked_mse(p, target, small), pred)
    assert torch.autograd.gradcheck(lambda p: masked_ssim(p, target, small), pred)
    rows = images(5, 3, seed=2).requires_grad_()
    for loss in (color_spread, scale_size, squared_norm):
        assert torch.autograd.gradcheck(loss, rows)
    assert torch.autograd.gradcheck(lbs_deviation, (rows, images(5, 3, seed=3)))


def test_a_mean_over_no_subject_is_zero() -> None:
    assert mean_of([]).item() == 0.0
    assert mean_of(torch.tensor(value) for value in (1.0, 4.0)).item() == pytest.approx(2.5)
