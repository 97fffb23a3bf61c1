"""Cropped and distorted files become the pinhole pictures that they were made from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from small_clip import FRAMES, small_annotation

from bigs.checks import InputError
from bigs.data.formats.arctic import load_arctic
from bigs.data.formats.writers import write_arctic
from bigs.data.optics import Optics, distort

# As strong as a lens worn on the head, with every kind of term.
LENS = np.array([-0.21, 0.06, 0.002, -0.003, 0.01, 0.05, -0.02, 0.004])
K = np.array([[90.0, 0.0, 78.0], [0.0, 95.0, 61.0], [0.0, 0.0, 1.0]])
SIZE = (160, 120)


def colmap_camera() -> pycolmap.Camera:
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *LENS]
    return pycolmap.Camera(model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=params)


def scenery(rays: np.ndarray) -> np.ndarray:
    """A smooth colour for each direction [..., 2], uint8."""
    x, y = rays[..., 0], rays[..., 1]
    waves = np.stack([np.sin(6 * x + 2 * y), np.cos(5 * y), np.sin(4 * (x - y))], axis=-1)
    return np.rint(127.5 + 100 * waves).astype(np.uint8)


def pixel_centers(size: tuple[int, int]) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), axis=-1)


def pinhole_picture(size: tuple[int, int] = SIZE) -> np.ndarray:
    return scenery((pixel_centers(size) - K[:2, 2]) / K[[0, 1], [0, 1]])


def distorted_picture() -> np.ndarray:
    """What the lens shows, by COLMAP's own way back from pixels to directions."""
    rays = colmap_camera().cam_from_img(pixel_centers(SIZE).reshape(-1, 2))
    return scenery(np.asarray(rays).reshape(SIZE[1], SIZE[0], -1)[..., :2])


def whole(**changes: object) -> Optics:
    boxes = np.array([[0.0, 0.0, *SIZE]])
    return replace(Optics(K, SIZE, SIZE, boxes, np.zeros(8)), **changes)


def test_the_lens_is_opencvs() -> None:
    rays = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 2))
    expected = colmap_camera().img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(distort(rays, LENS) @ K[:2, :2].T + K[:2, 2], expected, atol=1e-9)


def test_a_lens_that_folds_shows_nothing_beyond() -> None:
    fold = np.array([-0.3, 0, 0, 0, 0, 0, 0, 0])  # r (1 - 0.3 r²) turns round at 1.054
    bent = distort(np.array([[1.0, 0.0], [1.06, 0.0], [3.0, 0.0]]), fold)
    np.testing.assert_array_equal(np.isnan(bent[:, 0]), [False, True, True])


def test_distortion_is_undone() -> None:
    found = whole(distortion=LENS).pinhole(0, distorted_picture(), order=1)
    wrong = np.abs(found.astype(int) - pinhole_picture()).max(axis=-1)
    seen = found.any(axis=-1)
    assert seen.mean() > 0.8 and seen[30:90, 40:120].all()
    assert wrong[seen].max() <= 4
    assert np.abs(distorted_picture().astype(int) - pinhole_picture()).max(axis=-1).mean() > 10


def test_labels_are_not_mixed() -> None:
    labels = np.where(distorted_picture()[..., 0] > 127, 250, 50).astype(np.uint8)
    found = whole(distortion=LENS).pinhole(0, labels, order=0)
    assert set(np.unique(found)) <= {0, 50, 250}


def cut_out(picture: np.ndarray, box: tuple[int, int, int, int], side: int) -> np.ndarray:
    """A square part of a picture, black where it reaches beyond, at another size."""
    return np.asarray(Image.fromarray(picture).crop(box).resize((side, side), Image.Resampling.BICUBIC))


def test_a_crop_goes_back_to_its_place() -> None:
    box = (-10, 20, 80, 110)
    optics = whole(file_size=(200, 200), boxes=np.array([box], dtype=float))
    found = optics.pinhole(0, cut_out(pinhole_picture(), box, 200), order=1)
    inside = np.zeros(found.shape[:2], dtype=bool)
    inside[20:110, :80] = True
    assert not found[~inside].any()
    wrong = np.abs(found.astype(int) - pinhole_picture())[21:109, 1:79]
    assert wrong.max() <= 6 and wrong.mean() < 1


# --- ARCTIC's ---


@pytest.fixture
def root(tmp_path: Path) -> Path:
    annotation = replace(small_annotation(), width=SIZE[0], height=SIZE[1], K=K)
    pictures = np.repeat(pinhole_picture()[None], FRAMES, axis=0)
    write_arctic(tmp_path, annotation, subject="s01", sequence="box_grab_01", images=pictures)
    return tmp_path


def rewrite(root: Path, view: int, make: Callable[[int], np.ndarray], tree: str = "images") -> Path:
    folder = root / tree / "s01" / "box_grab_01" / str(view)
    folder.mkdir(parents=True)
    for t in range(FRAMES):
        Image.fromarray(make(t)).save(folder / f"{100 + t:05d}.jpg", quality=97)
    return folder


def test_cropped_images_of_arctic(root: Path) -> None:
    """A square of 1.5 times the box, in every frame another, as one camera saw the whole."""
    (root / "images").rename(root / "whole")
    boxes = [(10 + 5 * t, 8, 100 + 5 * t, 98) for t in range(FRAMES)]
    folder = rewrite(root, 1, lambda t: cut_out(pinhole_picture(), boxes[t], 180), "cropped_images")
    with pytest.raises(InputError, match=r"in .*processed/seqs/s01/box_grab_01.npy the boxes"):
        load_arctic(folder)
    stored = np.full((FRAMES, 9, 3), 7.0)
    stored[:, 1] = [((x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 300) for x0, y0, x1, y1 in boxes]
    file = root / "processed" / "seqs" / "s01" / "box_grab_01.npy"
    file.parent.mkdir(parents=True)
    np.save(file, np.array({"bbox": stored}, dtype=np.object_))
    clip = load_arctic(folder)
    assert (clip.width, clip.height) == SIZE and len(clip) == FRAMES
    np.testing.assert_array_equal(clip.K, K)
    for t in (0, 3):
        x0, y0, x1, y1 = boxes[t]
        wrong = np.abs(clip.image(t).astype(int) - pinhole_picture())[y0 + 1 : y1 - 1, x0 + 1 : x1 - 1]
        assert np.median(wrong) <= 3
        assert not clip.image(t)[:, : x0 - 1].any()


def egocentric(root: Path, **fields: np.ndarray) -> None:
    standing = {
        "R_k_cam_np": np.repeat(np.eye(3)[None], FRAMES, axis=0),
        "T_k_cam_np": np.zeros((FRAMES, 3, 1)),
        "intrinsics": K,
    }
    file = root / "raw_seqs" / "s01" / "box_grab_01.egocam.dist.npy"
    np.save(file, np.array(standing | fields, dtype=np.object_))


def test_a_bent_picture_is_decoded_once(root: Path, reads: Counter[str]) -> None:
    egocentric(root, dist8=LENS)
    clip = load_arctic(rewrite(root, 0, lambda t: distorted_picture()))
    assert clip.optics is not None
    for _ in range(2):
        for t in range(FRAMES):
            clip.image(t)
    assert set(reads.values()) == {1} and len(reads) == FRAMES


def test_arctics_egocentric_view_is_straightened(root: Path) -> None:
    egocentric(root, dist8=LENS)
    clip = load_arctic(rewrite(root, 0, lambda t: distorted_picture()))
    middle = (slice(30, 90), slice(40, 120))
    assert np.median(np.abs(clip.image(2).astype(int) - pinhole_picture())[middle]) <= 3
    egocentric(root)
    bent = load_arctic(root / "images" / "s01" / "box_grab_01" / "0")
    assert bent.optics is None
    assert np.median(np.abs(bent.image(2).astype(int) - pinhole_picture())) > 8


def test_its_cropped_images_are_whole_and_smaller(root: Path) -> None:
    egocentric(root, dist8=LENS)
    smaller = np.asarray(Image.fromarray(distorted_picture()).resize((120, 90), Image.Resampling.BICUBIC))
    clip = load_arctic(rewrite(root, 0, lambda t: smaller, "cropped_images"))
    wrong = np.abs(clip.image(1).astype(int) - pinhole_picture())[30:90, 40:120]
    assert np.median(wrong) <= 4
