"""Image scores by their definitions: which pixels count, and what is blanked."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from bigs.metrics.image import ssim_map
from bigs.metrics.picture import PICTURE_METRICS, _similarity, aligned_psnr, picture_scores


@pytest.fixture
def pictures() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    render, image = rng.random((24, 30, 3)), rng.random((24, 30, 3))
    mask = np.zeros((24, 30), dtype=bool)
    mask[5:18, 8:25] = rng.random((13, 17)) > 0.2
    return render, image, mask


def test_scores_are_those_of_plain_formulas(pictures: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    render, image, mask = pictures
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def distance(a: object, b: object) -> float:
        seen.append((np.asarray(a)[0].transpose(1, 2, 0), np.asarray(b)[0].transpose(1, 2, 0)))
        return float(len(seen))

    found = picture_scores(render, image, mask, distance)
    blanked, cut = image * mask[..., None], render * mask[..., None]
    inside = np.mean((render - image)[mask] ** 2)
    assert found["psnr_foreground"] == pytest.approx(-10 * np.log10(inside), abs=1e-4)
    whole = np.mean((render - blanked) ** 2)
    assert found["psnr_full"] == pytest.approx(-10 * np.log10(whole), abs=1e-4)

    def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        # A wide black frame stands for the zeros that the window sees outside.
        padded = [np.pad(x, ((12, 12), (12, 12), (0, 0))) for x in (a, b)]
        _, full = structural_similarity(
            *padded,
            channel_axis=2,
            data_range=1.0,
            gaussian_weights=True,
            use_sample_covariance=False,
            full=True,
        )
        return full[12:-12, 12:-12].mean(axis=2)

    assert found["ssim_full"] == pytest.approx(ssim_map(render, blanked).mean(), abs=1e-4)
    assert found["ssim_foreground"] == pytest.approx(ssim_map(cut, blanked).mean(), abs=1e-4)
    assert found["ssim_inside"] == pytest.approx(ssim_map(cut, blanked)[mask].mean(), abs=1e-4)
    assert (found["lpips_foreground"], found["lpips_full"]) == (1.0, 2.0)
    for (pred, gt), expected in zip(seen, (cut, render), strict=True):
        np.testing.assert_allclose(pred, expected, atol=1e-6)
        np.testing.assert_allclose(gt, blanked, atol=1e-6)


def test_what_lies_outside_the_mask_counts_only_in_the_whole_frame(
    pictures: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    _, image, mask = pictures
    spilled = np.where(mask[..., None], image, 0.5)
    found = picture_scores(spilled, image, mask)
    assert found["psnr_foreground"] == np.inf and found["ssim_foreground"] == pytest.approx(1.0)
    assert found["psnr_full"] < 12 and found["ssim_full"] < 0.9
    clean = picture_scores(np.where(mask[..., None], image, 0.0), image, mask)
    assert clean["psnr_full"] == np.inf


def test_an_empty_mask_has_no_score(pictures: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    render, image, mask = pictures
    found = picture_scores(render, image, np.zeros_like(mask), lambda a, b: 0.0)
    assert np.isnan(list(found.values())).all()
    assert set(found) == {key for key in PICTURE_METRICS if not key.startswith("novel_")}


def test_each_subject_is_compared_where_it_fits_best() -> None:
    rng = np.random.default_rng(5)
    image = rng.random((48, 64, 3))
    masks = {"cup": np.zeros((48, 64), dtype=bool), "hand": np.zeros((48, 64), dtype=bool)}
    masks["cup"][12:24, 10:30], masks["hand"][30:36, 30:50] = True, True
    shifts = {"cup": (-3, 7), "hand": (5, -6)}
    noise = 0.1 * rng.standard_normal(image.shape)
    renders = {name: np.roll(image + noise, shift, axis=(0, 1)) for name, shift in shifts.items()}
    errors = {name: np.mean(noise[mask] ** 2) for name, mask in masks.items()}
    areas = {name: mask.sum() for name, mask in masks.items()}
    expected = -10 * sum(areas[n] * np.log10(errors[n]) for n in masks) / sum(areas.values())
    assert aligned_psnr(renders, image, masks) == pytest.approx(expected)
    # One pixel beyond the reach, and what is found is no better than any other shift of noise.
    assert aligned_psnr(renders, image, masks, reach=7) < expected - 3.0
    assert aligned_psnr(dict.fromkeys(masks, image), image, masks) == np.inf
    assert np.isnan(aligned_psnr(renders, image, dict.fromkeys(masks, np.zeros((48, 64), dtype=bool))))


def test_what_is_black_in_both_pictures_is_alike(
    pictures: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """The map is the same, bit by bit, whether or not black parts are left out."""
    for offset in ((0, 0), (3, 20), (36, 30)):
        pair = torch.zeros(2, 1, 3, 60, 60)
        rows, columns = (slice(start, start + size) for start, size in zip(offset, (24, 30), strict=True))
        pair[:, 0, :, rows, columns] = torch.as_tensor(np.stack(pictures[:2])).permute(0, 3, 1, 2)
        found = _similarity(*pair)
        assert found.equal(ssim_map(*pair).mean(dim=1))
        assert (found == 1.0).any()
    assert _similarity(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8)).equal(torch.ones(1, 8, 8))
