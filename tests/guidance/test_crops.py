"""Pictures of the object alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.guidance.crops import ZOOMS, Crop, choose_frames, cut_crop, draw_pictures


def frame(top: int, left: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A grey 90 x 120 frame with a red box, and the box's mask."""
    image, mask = np.full((90, 120, 3), 100, np.uint8), np.zeros((90, 120), bool)
    place = slice(top, top + height), slice(left, left + width)
    image[place], mask[place] = (200, 20, 10), True
    return image, mask


def test_frames_are_spread_over_those_that_show_the_object() -> None:
    areas = np.array([0, 900, 1000, 10, 240, 260, 1000, 800])
    assert choose_frames("CLIP", areas, 64) == [1, 2, 5, 6, 7]
    assert choose_frames("CLIP", areas, 3) == [1, 5, 7]
    with pytest.raises(InputError, match=r"CLIP: masks: expected a frame .* found at most 63"):
        choose_frames("CLIP", np.array([63, 0]), 8)


def test_a_crop_is_a_square_around_the_object() -> None:
    crop = cut_crop(*frame(30, 40, 10, 20), size=512)
    assert crop.picture.shape == (3, 32, 32)
    rows, columns = torch.nonzero(crop.mask[0], as_tuple=True)
    assert (int(rows.min()), int(rows.max()), int(columns.min()), int(columns.max())) == (11, 20, 6, 25)
    assert crop.picture[:, 15, 15].tolist() == [200, 20, 10]
    assert crop.picture[:, 0, 0].tolist() == [255, 255, 255]


@pytest.mark.parametrize("corner", [(0, 0), (80, 100), (0, 100), (80, 0)])
def test_at_the_frames_border_too(corner: tuple[int, int]) -> None:
    crop = cut_crop(*frame(*corner, 10, 20), size=512)
    assert crop.picture.shape == (3, 32, 32)
    assert int((crop.mask > 0).sum()) == 200
    assert torch.equal(crop.picture[1] == 20, crop.mask[0] > 0)


@pytest.mark.parametrize("size", [16, 512])
def test_nothing_of_what_is_around_the_object_remains(size: int) -> None:
    image, mask = frame(30, 40, 30, 30)
    mask[35:45] = False  # as if a hand lay across it
    other = np.where(mask[..., None], image, 0)
    crops = [cut_crop(picture, mask, size) for picture in (image, other)]
    assert torch.equal(crops[0].picture, crops[1].picture)
    assert crops[0].picture.amin() < 50


def test_large_crops_are_made_as_small_as_steps_can_use() -> None:
    crop = cut_crop(*frame(5, 10, 80, 100), size=32)
    assert crop.picture.shape == (3, 47, 47)
    assert crop.picture.dtype == torch.uint8


def drawn(crops: list[Crop], seed: int, count: int = 4, size: int = 64) -> tuple[Tensor, Tensor]:
    return draw_pictures(crops, count, size, torch.Generator().manual_seed(seed))


def test_drawn_pictures_hold_the_whole_object_over_white() -> None:
    crops = [cut_crop(*frame(30, 40, 30, 30), size=64)]
    for seed in range(20):
        pictures, shares = drawn(crops, seed)
        assert pictures.shape == (4, 3, 64, 64)
        assert shares.shape == (4, 1, 64, 64)
        beyond = shares[:, 0] == 0
        assert bool((pictures.amin(1)[beyond] > 0.999).all())
        inside = shares[:, 0] > 0.9999
        assert torch.allclose(
            pictures.permute(0, 2, 3, 1)[inside], torch.tensor([200.0, 20, 10]) / 255, atol=0.02
        )
        # The object fills between 1 / 1.6 and 1 / 1.1 of each side, so its area is the square of that.
        areas = shares.mean((1, 2, 3)).sqrt()
        assert float(areas.min()) > 0.95 / ZOOMS[1]
        assert float(areas.max()) < 1.05 / ZOOMS[0]


def test_draws_are_a_function_of_the_generator_and_vary() -> None:
    crops = [cut_crop(*frame(30, 40, 30, 30), size=64), cut_crop(*frame(10, 10, 20, 40), size=64)]
    assert torch.equal(drawn(crops, 1)[0], drawn(crops, 1)[0])
    assert not torch.equal(drawn(crops, 1)[0], drawn(crops, 2)[0])
    ratios = [float(s.amax(2).sum() / s.amax(3).sum()) for s in drawn(crops, 3, 12)[1].split(1)]
    assert min(ratios) < 1.2 < max(ratios)
