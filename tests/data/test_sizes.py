"""Sizes that a data set announces: of pictures, and of meshes in all frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bigs.checks import InputError, check_product
from bigs.data.formats.arctic import camera_of_images
from bigs.data.ground_truth import load_annotation, load_ground_truth


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ([1e9, 1e9], "expected at most .* pixels, found 1000000000 x 1000000000"),
        ([0, 600], "expected widths and heights in pixels"),
        ([800.5, 600], "expected widths and heights in pixels"),
    ],
)
def test_pictures_of_arctic(tmp_path: Path, size: list[float], words: str) -> None:
    (tmp_path / "meta").mkdir()
    meta = {"s01": {"image_size": [size] * 9, "intris_mat": [np.eye(3).tolist()] * 8}}
    (tmp_path / "meta" / "misc.json").write_text(json.dumps(meta))
    with pytest.raises(InputError, match=rf"misc\.json: s01\.image_size: {words}"):
        camera_of_images(tmp_path / "images" / "s01" / "box_grab_01" / "1")


@pytest.mark.parametrize("load", [load_ground_truth, load_annotation])
def test_a_mesh_in_all_frames(tmp_path: Path, load: object) -> None:
    """A hundred thousand poses, which shrink to kilobytes, of a thousand vertices."""
    frames = 100_000
    np.savez_compressed(
        tmp_path / "gt.npz",
        K=np.diag([500.0, 500.0, 1.0]),
        wh=[640, 480],
        obj_R=np.broadcast_to(np.eye(3), (frames, 3, 3)),
        obj_t=np.zeros((frames, 3)),
    )
    trimesh.creation.icosphere(4, 0.05).export(tmp_path / "gt_object.ply")
    assert (tmp_path / "gt.npz").stat().st_size < 1 << 20
    with pytest.raises(
        InputError, match=r"gt\.npz: gt_object\.ply: expected at most .* found 100000 frames of 2562"
    ):
        load(tmp_path)  # type: ignore[operator]


def test_the_longest_sequence_of_the_largest_mesh_is_read() -> None:
    check_product("clip", 1200, 80_000)


def test_pictures_of_ground_truth(tmp_path: Path) -> None:
    np.savez(tmp_path / "gt.npz", K=np.diag([500.0, 500.0, 1.0]), wh=[1e9, 1e9])
    with pytest.raises(InputError, match=r"gt\.npz: wh: expected at most .* pixels"):
        load_annotation(tmp_path)
