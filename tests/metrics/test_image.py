"""PSNR and SSIM against hand-computed values and kornia."""

import kornia
import pytest
import torch
import torch.nn.functional as F

from bigs.checks import InputError
from bigs.metrics.image import psnr, ssim, ssim_map


@pytest.fixture
def images():
    generator = torch.Generator().manual_seed(3)
    gt = torch.rand(2, 3, 30, 41, generator=generator, dtype=torch.float64)
    noise = torch.rand(2, 3, 30, 41, generator=generator, dtype=torch.float64)
    return (gt + 0.3 * (noise - 0.5)).clamp(0, 1), gt


def test_identical_images_are_perfect(images):
    _, gt = images
    assert psnr(gt, gt) == torch.inf
    assert torch.allclose(ssim_map(gt, gt), torch.ones_like(gt), atol=1e-12)


def test_psnr_of_a_known_offset():
    gt = torch.full((2, 3, 5, 7), 0.4)
    assert psnr(gt + 0.1, gt).item() == pytest.approx(20.0, abs=1e-4)


def test_psnr_is_the_mean_of_the_images_decibels():
    gt = torch.zeros(2, 3, 4, 4)
    pred = gt.clone()
    pred[0], pred[1] = 0.1, 0.01
    assert psnr(pred, gt).item() == pytest.approx(30.0, abs=1e-4)


def test_psnr_ignores_pixels_outside_the_mask():
    gt = torch.zeros(1, 3, 6, 6)
    pred = torch.ones_like(gt)
    mask = torch.zeros(1, 6, 6, dtype=torch.bool)
    mask[:, 2:4, 1:5] = True
    pred[:, :, 2:4, 1:5] = 0.1
    assert psnr(pred, gt, mask).item() == pytest.approx(20.0, abs=1e-4)
    assert psnr(pred, gt, mask[:, None].float()).item() == pytest.approx(20.0, abs=1e-4)


def test_ssim_is_kornias_inside_the_border(images):
    pred, gt = images
    oracle = kornia.metrics.ssim(pred, gt, window_size=11, padding="same")
    inside = (..., slice(5, -5), slice(5, -5))
    assert torch.allclose(ssim_map(pred, gt)[inside], oracle[inside], atol=1e-9)


def test_ssim_sees_zeros_outside_the_image(images):
    pred, gt = images
    padded = [F.pad(image, (10, 10, 10, 10)) for image in images]
    oracle = kornia.metrics.ssim(*padded, window_size=11, padding="same")[..., 10:-10, 10:-10]
    assert torch.allclose(ssim_map(pred, gt), oracle, atol=1e-9)
    assert ssim(pred, gt).item() == pytest.approx(oracle.mean().item(), abs=1e-9)


def test_ssim_mask_selects_pixels_of_the_map(images):
    pred, gt = images
    mask = torch.zeros(2, 30, 41)
    mask[0, 3:9, 4:30], mask[1, 10:12, 2:5] = 1.0, 1.0
    full = ssim_map(pred, gt)
    expected = 0.5 * (full[0, :, 3:9, 4:30].mean() + full[1, :, 10:12, 2:5].mean())
    assert ssim(pred, gt, mask).item() == pytest.approx(expected.item(), abs=1e-6)


def test_ssim_gradients_of_both_images(images):
    pred, gt = (image[:1, :2, :5, :6].clone().requires_grad_() for image in images)
    assert torch.autograd.gradcheck(lambda p, g: ssim_map(p, g, window=5), (pred, gt))
    assert torch.autograd.gradcheck(lambda p: ssim_map(p, gt.detach(), window=5), (pred,))
    assert torch.autograd.gradcheck(lambda g: ssim_map(pred.detach(), g, window=5), (gt,))


def test_float32_gradient_agrees_with_float64(images):
    grads = []
    for dtype in (torch.float32, torch.float64):
        pred, gt = (image.to(dtype) for image in images)
        pred.requires_grad_()
        grads.append(torch.autograd.grad(ssim(pred, gt), pred)[0].double())
    assert (grads[0] - grads[1]).norm() < 1e-5 * grads[1].norm()


def test_bad_arguments_are_named(images):
    pred, gt = images
    with pytest.raises(InputError, match=r"gt: expected shape \[2, 3, 30, 41\], found \[1, 3, 30, 41\]"):
        psnr(pred, gt[:1])
    with pytest.raises(InputError, match="mask"):
        ssim(pred, gt, torch.ones(2, 30, 40))
    with pytest.raises(InputError, match="window: expected an odd"):
        ssim_map(pred, gt, window=10)
