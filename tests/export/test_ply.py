"""Splat PLY: the bytes as an independent parser sees them, the round trip, and files that are not right."""

import struct

import numpy as np
import pytest
import torch

from bigs.checks import InputError
from bigs.export.ply import load_splats, save_splats
from bigs.types import Gaussians


@pytest.fixture
def gaussians():
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(7, 3, generator=generator),
        quats=torch.nn.functional.normalize(torch.randn(7, 4, generator=generator), dim=-1),
        scales=0.01 * torch.rand(7, 3, generator=generator) + 1e-4,
        opacities=0.8 * torch.rand(7, generator=generator) + 0.1,
        colors=torch.rand(7, 3, generator=generator),
    )


def independent_parse(path):
    """The file by the PLY specification: one dictionary per vertex."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:-1]]
    rows = list(struct.iter_unpack(f"<{len(names)}f", body))
    assert len(rows) == count
    return names, [dict(zip(names, row, strict=True)) for row in rows]


def test_bytes_are_what_viewers_expect(tmp_path, gaussians):
    save_splats(tmp_path / "a.ply", gaussians)
    names, rows = independent_parse(tmp_path / "a.ply")
    assert names == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
        *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    for i, row in enumerate(rows):
        assert [row[k] for k in "xyz"] == gaussians.means[i].tolist()
        assert [row[f"n{k}"] for k in "xyz"] == [0.0, 0.0, 0.0]
        color = [0.5 + 0.28209479 * row[f"f_dc_{k}"] for k in range(3)]
        assert color == pytest.approx(gaussians.colors[i].tolist(), abs=1e-6)
        assert 1 / (1 + np.exp(-row["opacity"])) == pytest.approx(gaussians.opacities[i].item(), abs=1e-6)
        scales = np.exp([row[f"scale_{k}"] for k in range(3)])
        assert scales == pytest.approx(gaussians.scales[i].tolist(), rel=1e-5)
        assert [row[f"rot_{k}"] for k in range(4)] == pytest.approx(gaussians.quats[i].tolist(), abs=1e-7)


def test_round_trip(tmp_path, gaussians):
    save_splats(tmp_path / "a.ply", gaussians)
    for name, written, read in zip(
        Gaussians._fields, gaussians, load_splats(tmp_path / "a.ply"), strict=True
    ):
        assert read.dtype == torch.float32
        assert torch.allclose(written, read, rtol=1e-5, atol=1e-6), name


def test_extremes_stay_finite(tmp_path, gaussians):
    hard = gaussians._replace(
        opacities=torch.tensor([0.0, 1.0, 0.0, 1.0, 0.5, 0.5, 0.5]), scales=torch.zeros(7, 3)
    )
    save_splats(tmp_path / "a.ply", hard)
    read = load_splats(tmp_path / "a.ply")
    assert torch.allclose(read.opacities, hard.opacities, atol=2e-6)
    assert read.scales.max() < 1e-10


def test_no_gaussians_are_a_legal_file(tmp_path):
    empty = Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (3,))))
    save_splats(tmp_path / "a.ply", empty)
    assert load_splats(tmp_path / "a.ply").means.shape == (0, 3)


def test_other_programs_properties_are_passed_over(tmp_path, gaussians):
    save_splats(tmp_path / "a.ply", gaussians)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    extra = header.replace(b"property float opacity\n", b"property uchar tag\nproperty float opacity\n")
    rows = [body[i : i + 68] for i in range(0, len(body), 68)]
    content = (
        extra + b"comment made elsewhere\nend_header\n" + b"".join(r[:36] + b"\7" + r[36:] for r in rows)
    )
    (tmp_path / "b.ply").write_bytes(content)
    assert torch.equal(load_splats(tmp_path / "b.ply").quats, load_splats(tmp_path / "a.ply").quats)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda b: b[:-4], "expected 476 bytes after the header .*, found 472"),
        (lambda b: b + b"\0", "found 477"),
        (lambda b: b.replace(b"binary_little_endian", b"ascii"), "found format ascii 1.0"),
        (lambda b: b.replace(b"property float opacity\n", b""), "expected vertex property opacity"),
        (lambda b: b.replace(b"float nx", b"list uchar int nx"), "expected scalar vertex properties"),
        (lambda b: b.replace(b"float nx", b"float x"), "expected scalar vertex properties"),
        (lambda b: b.replace(b"element vertex 7", b"element vertex -7"), "expected 'element vertex N'"),
        (lambda b: b"solid" + b, "expected a PLY file"),
        (lambda b: b[:40], "expected a PLY file"),
        (lambda b: b[:-68] + struct.pack("<f", np.nan) + b[-64:], "x: expected finite values, found nan"),
    ],
)
def test_damaged_files_are_named(tmp_path, gaussians, damage, message):
    save_splats(tmp_path / "a.ply", gaussians)
    (tmp_path / "a.ply").write_bytes(damage((tmp_path / "a.ply").read_bytes()))
    with pytest.raises(InputError, match=message):
        load_splats(tmp_path / "a.ply")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"gone\.ply: expected a splat PLY file"):
        load_splats(tmp_path / "gone.ply")


def test_nothing_is_written_for_bad_values(tmp_path, gaussians):
    poisoned = gaussians._replace(scales=gaussians.scales.index_fill(0, torch.tensor([3]), torch.nan))
    with pytest.raises(InputError, match=r"scales: expected finite values, found nan at index \[3, 0\]"):
        save_splats(tmp_path / "a.ply", poisoned)
    with pytest.raises(InputError, match=r"colors: expected shape \[7, 3\]"):
        save_splats(tmp_path / "a.ply", gaussians._replace(colors=torch.zeros(7, 6)))
    assert list(tmp_path.iterdir()) == []
