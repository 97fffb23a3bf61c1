"""Contact sheets and videos: the right pictures in the right places."""

import sys

import numpy as np
import pytest
from PIL import Image

from bigs.checks import InputError
from bigs.viewer.preview import contact_sheet, difference, overlay, save_picture, to_bytes, write_video

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def plain(color, height=30, width=40):
    return np.full((height, width, 3), color, dtype=np.uint8)


def test_images_sit_in_their_row_and_column():
    sheet = contact_sheet(
        {"input": [plain(RED), plain(GREEN)], "render": [plain(BLUE), None]},
        ["frame 0", "frame 9"],
        cell_width=80,
    )
    pixels = np.asarray(sheet)
    found = {}
    for name, color in (("red", RED), ("green", GREEN), ("blue", BLUE)):
        rows, columns = np.nonzero((pixels == color).all(axis=-1))
        assert len(rows) == 80 * 60
        found[name] = rows.mean(), columns.mean()
    assert found["red"][0] == found["green"][0] < found["blue"][0]
    assert found["red"][1] == found["blue"][1] < found["green"][1]


def test_captions_are_drawn():
    rows = {"input": [plain(RED)]}
    dark = [
        (np.asarray(contact_sheet(rows, [caption])).astype(int).sum(axis=-1) < 200).sum()
        for caption in (
            " ",
            "frame 12",
            "a caption so long that it cannot fit above its column at all, by far",
        )
    ]
    assert dark[0] < dark[1] < dark[2]


def test_a_sheet_that_does_not_fit_together_is_named():
    with pytest.raises(InputError, match="'input': expected 2 images, found 1"):
        contact_sheet({"input": [plain(RED)]}, ["a", "b"])
    with pytest.raises(InputError, match=r"'input': expected shape \[H, W, 3\], found \[30, 40\]"):
        contact_sheet({"input": [plain(RED)[..., 0]]}, ["a"])
    with pytest.raises(InputError, match="found 0 rows"):
        contact_sheet({}, ["a"])


def test_floats_become_bytes():
    image = np.array([[[0.0, 0.5, 1.0], [-1.0, 2.0, np.nan]]])
    assert to_bytes(image).tolist() == [[[0, 128, 255], [0, 255, 0]]]


def test_difference_is_grey_where_equal():
    render, image = plain((100, 100, 100)), plain((100, 90, 200))
    assert difference(render, image)[0, 0].tolist() == [128, 158, 0]


def test_overlay_covers_only_where_there_is_something():
    alpha = np.zeros((30, 40))
    alpha[:10] = 1.0
    mixed = overlay(plain(RED) * (alpha[..., None] > 0), alpha, plain(BLUE), strength=0.6)
    assert mixed[0, 0].tolist() == [153, 0, 102]
    assert mixed[20, 0].tolist() == [0, 0, 255]


def test_pictures_are_written_by_suffix(tmp_path):
    picture = Image.fromarray(plain(GREEN))
    save_picture(tmp_path / "a.png", picture)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), plain(GREEN))
    with pytest.raises(InputError, match=r"expected \.png or \.jpg, found \.gif"):
        save_picture(tmp_path / "a.gif", picture)
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_a_video_shows_its_frames(tmp_path):
    av = pytest.importorskip("av")
    colors = [(200, 40, 40), (40, 200, 40), (40, 40, 200)]
    write_video(tmp_path / "a.mp4", (plain(color, 31, 41) / 255.0 for color in colors), fps=12.5)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert float(stream.average_rate) == pytest.approx(12.5)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert [frame.shape for frame in frames] == [(32, 42, 3)] * 3
    for frame, color in zip(frames, colors, strict=True):
        assert np.abs(frame.mean(axis=(0, 1)) - color).max() < 8


def test_no_half_video_is_left(tmp_path):
    pytest.importorskip("av")

    def broken():
        yield plain(RED)
        raise RuntimeError("the renderer failed")

    with pytest.raises(RuntimeError, match="the renderer failed"):
        write_video(tmp_path / "a.mp4", broken(), 10)
    with pytest.raises(InputError, match="expected at least one frame"):
        write_video(tmp_path / "a.mp4", [], 10)
    with pytest.raises(InputError, match=r"frame 1: expected shape \[30, 40, 3\], found \[30, 44, 3\]"):
        write_video(tmp_path / "a.mp4", [plain(RED), plain(RED, 30, 44)], 10)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_video_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"expected the extra 'video' \(pip install 'bigs\[video\]'\)"):
        write_video(tmp_path / "a.mp4", [plain(RED)], 10)


@pytest.mark.parametrize("size", [(3000, 20), (20, 3000), (12000, 2), (1, 1)])
def test_pictures_of_any_proportions(tmp_path, size):
    image = np.full((*size, 3), 200, dtype=np.uint8)
    sheet = contact_sheet({"input": [image], "render": [image]}, ["frame 0"])
    assert max(sheet.size) < 2000
    save_picture(tmp_path / "sheet.jpg", sheet)
    write_video(tmp_path / "strip.mp4", [np.concatenate([image] * 3, axis=1)], fps=5)
    assert (tmp_path / "strip.mp4").stat().st_size > 0
