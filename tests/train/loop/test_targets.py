"""Targets: the crop keeps camera and image content together, and shares are shares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_clips import painted_clip

from bigs.data.base import Clip
from bigs.train.loop.targets import crop_box, load_targets, share_per_pixel

WIDTH, HEIGHT = 90, 64
K = np.array([[80.0, 0.0, 47.3], [0.0, 84.0, 29.8], [0.0, 0.0, 1.0]])
# Three frames, one point each, well inside the image (metres, camera frame).
POINTS = np.array([[-0.06, 0.02, 0.5], [0.05, -0.04, 0.45], [0.08, 0.05, 0.6]])


def project(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    pixels = points @ matrix.T
    return pixels[:, :2] / pixels[:, 2:]


def blobs() -> tuple[np.ndarray, np.ndarray]:
    """A soft blob [T, H, W] centred where each point projects, and the masks of its core."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    u, v = project(POINTS, K).T[:, :, None, None]
    blob = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 4.0**2))
    return blob, np.where(blob > 0.3, np.uint8(50), np.uint8(0))


@pytest.fixture
def clip(tmp_path: Path) -> Clip:
    blob, masks = blobs()
    images = np.repeat((255 * blob).round().astype(np.uint8)[..., None], 3, axis=-1)
    return painted_clip(tmp_path, images, masks, K)


def centroid(weights: np.ndarray) -> np.ndarray:
    """The mean position (x, y) in pixels, centres at +0.5."""
    x, y = np.meshgrid(np.arange(weights.shape[1]) + 0.5, np.arange(weights.shape[0]) + 0.5)
    return np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()


@pytest.mark.parametrize("scale", [1.0, 0.61, 0.4])
@pytest.mark.parametrize("box", [(0, 0, WIDTH, HEIGHT), (11, 3, 85, 61), (4, 0, 87, 59)])
def test_a_projected_point_shows_the_same_content(
    clip: Clip, scale: float, box: tuple[int, int, int, int]
) -> None:
    nothing = np.zeros((3, HEIGHT, WIDTH), dtype=bool)
    targets = load_targets(clip, nothing, scale, box)
    assert targets.images.shape == (3, targets.height, targets.width, 3)
    assert targets.width == round(scale * (box[2] - box[0]))
    expected = project(POINTS, targets.K.double().numpy())
    for t in range(3):
        found = centroid(targets.images[t, ..., 0].double().numpy())
        # The blob is cut where it nears the border, hence not exactly zero.
        assert np.abs(found - expected[t]).max() < 0.15
        share = centroid(targets.shares["object"][t].double().numpy())
        assert np.abs(share - expected[t]).max() < 0.15


def test_the_full_clip_is_itself(clip: Clip) -> None:
    nothing = np.zeros((3, HEIGHT, WIDTH), dtype=bool)
    targets = load_targets(clip, nothing, 1.0, (0, 0, WIDTH, HEIGHT))
    np.testing.assert_allclose(targets.images.numpy() * 255, [clip.image(t) for t in range(3)], atol=1e-4)
    np.testing.assert_allclose(targets.K.numpy(), K, rtol=1e-6)
    np.testing.assert_array_equal(
        targets.shares["object"].numpy(), [(clip.mask(t) == 50).astype(np.float32) for t in range(3)]
    )


def test_shares_are_shares(tiny: Clip) -> None:
    unknown = np.zeros((len(tiny), tiny.height, tiny.width), dtype=bool)
    unknown[:, :20] = True
    targets = load_targets(tiny, unknown, 0.37, crop_box(tiny))
    assert set(targets.shares) == {"right", "left", "object"}
    total = torch.stack(list(targets.shares.values())).sum(0)
    frames = torch.arange(len(tiny))
    foreground = targets.foreground[frames]
    for values in (*targets.shares.values(), targets.unknown, foreground, targets.hidden["right"][frames]):
        assert values.min() >= 0 and values.max() <= 1 + 1e-6
    assert total.max() <= 1 + 1e-5
    assert foreground.max() > 0.99
    area = np.array([tiny.mask_areas[entity].sum() for entity in ("right", "left", "object")])
    shares = np.array([targets.shares[entity].sum() for entity in ("right", "left", "object")])
    per_pixel = (targets.K[0, 0] * targets.K[1, 1] / (tiny.K[0, 0] * tiny.K[1, 1])).item()
    # No area is lost: the crop holds every labelled pixel.
    np.testing.assert_allclose(shares, per_pixel * area, rtol=0.01)


def test_hidden_is_everything_else(tiny: Clip) -> None:
    nothing = np.zeros((len(tiny), tiny.height, tiny.width), dtype=bool)
    targets = load_targets(tiny, nothing, 0.5, crop_box(tiny))
    frames = torch.tensor([2, 0])
    others = (targets.shares["right"] + targets.shares["object"])[frames]
    torch.testing.assert_close(targets.hidden["left"][frames], others)


def test_the_box_holds_everything_with_a_margin(clip: Clip, tiny: Clip) -> None:
    for one in (clip, tiny):
        x0, y0, x1, y1 = crop_box(one, margin=0.05)
        assert 0 <= x0 < x1 <= one.width and 0 <= y0 < y1 <= one.height
        labelled = np.any([one.mask(t) != 0 for t in range(len(one))], axis=0)
        outside = labelled.copy()
        outside[y0:y1, x0:x1] = False
        assert not outside.any()
        pad = int(np.ceil(0.05 * max(one.width, one.height)))
        rows, columns = np.flatnonzero(labelled.any(1)), np.flatnonzero(labelled.any(0))
        assert (x0, y0) == (max(columns[0] - pad, 0), max(rows[0] - pad, 0))
        assert (x1, y1) == (min(columns[-1] + 1 + pad, one.width), min(rows[-1] + 1 + pad, one.height))


def test_an_unlabelled_clip_is_not_cropped(tmp_path: Path) -> None:
    empty = painted_clip(tmp_path, np.zeros((2, 8, 9, 3), np.uint8), np.zeros((2, 8, 9), np.uint8))
    assert crop_box(empty) == (0, 0, 9, 8)


def test_share_per_pixel_is_the_area() -> None:
    mask = np.zeros((32, 32), dtype=bool)
    mask[8:24, 10:20] = True
    share = share_per_pixel(mask, 8, 8)
    assert share.shape == (8, 8)
    assert share.sum().item() == pytest.approx(mask.sum() / 16, rel=0.01)
    assert share[4, 3] > 0.95 and share[0, 0] == 0
