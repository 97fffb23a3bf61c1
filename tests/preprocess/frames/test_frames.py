"""Pictures of videos and folders become frames: upright, thinned, shrunk, with a camera."""

from __future__ import annotations

import builtins
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from bigs.checks import InputError
from bigs.preprocess.artefacts import FrameSet, frame_paths, read_frame_set
from bigs.preprocess.frames.camera import CameraRequest
from bigs.preprocess.frames.extract import FrameConfig, extract_frames, frame_inputs, sharpness
from bigs.preprocess.frames.source import is_source, open_source
from bigs.viewer.preview import write_video

WIDTH, HEIGHT = 96, 64


def picture(t: int, blur: bool = False) -> np.ndarray:
    """A red corner says which way is up, its brightness which frame it is."""
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    if not blur:
        image[::4, ::4] = 160
    image[:20, :20] = (150 + 8 * t, 20, 20)
    return image


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten pictures whose names sort wrongly as text; every third is sharp."""
    place = tmp_path / "pictures"
    place.mkdir()
    for t in range(10):
        Image.fromarray(picture(t, blur=t % 3 != 2)).save(place / f"shot{t + 1}.png")
    return place


def extract(path: Path, out: Path, **options: Any) -> FrameSet:
    source, config = open_source(path), FrameConfig(**options)
    return extract_frames(source, out, config, frame_inputs(source, config))


def red(path: Path) -> int:
    """Which picture a frame is."""
    return round((float(np.asarray(Image.open(path))[5:15, 5:15, 0].mean()) - 150) / 8)


def test_a_folder_in_the_order_of_its_numbers(folder: Path, tmp_path: Path) -> None:
    frames = extract(folder, tmp_path / "out")
    assert frames.names[:2] == ("shot1.png", "shot2.png") and frames.names[-1] == "shot10.png"
    assert [red(path) for path in frame_paths(tmp_path / "out", frames)] == list(range(10))
    assert vars(read_frame_set(tmp_path / "out"))["names"] == frames.names
    assert not frames.focal_known and frames.K[0, 0] == pytest.approx(1.2 * WIDTH)
    assert "assumed" in frames.camera


def test_stride_start_and_count(folder: Path, tmp_path: Path) -> None:
    frames = extract(folder, tmp_path / "out", stride=2, start=1, count=4)
    assert frames.source_frames == (1, 3, 5, 7) and frames.source_length == 10
    assert [red(path) for path in frame_paths(tmp_path / "out", frames)] == [1, 3, 5, 7]
    assert frames.fps == pytest.approx(15.0)


def test_the_source_may_be_faster_or_slower_than_it_says(folder: Path, tmp_path: Path) -> None:
    frames = extract(folder, tmp_path / "out", stride=2, fps=240.0)
    assert frames.fps == 120.0 and read_frame_set(tmp_path / "out").fps == 120.0


def test_images_of_which_some_were_left_out(folder: Path, tmp_path: Path) -> None:
    for file in folder.iterdir():
        if int(file.stem.removeprefix("shot")) % 2:
            file.unlink()
    assert extract(folder, tmp_path / "out").fps == 15.0


def test_the_sharpest_of_each_stride(folder: Path, tmp_path: Path) -> None:
    assert sharpness(picture(0)) > 4 * sharpness(picture(0, blur=True))
    frames = extract(folder, tmp_path / "out", stride=3, sharpest=True)
    assert frames.source_frames == (2, 5, 8, 9)


def test_fewer_frames_later_leave_none_of_the_earlier(folder: Path, tmp_path: Path) -> None:
    extract(folder, tmp_path / "out")
    extract(folder, tmp_path / "out", count=5)
    assert len(list((tmp_path / "out" / "frames").iterdir())) == 5


def test_large_pictures_are_shrunk_with_their_camera(folder: Path, tmp_path: Path) -> None:
    camera = CameraRequest(K=(200.0, 210.0, 50.0, 30.0))
    frames = extract(folder, tmp_path / "out", max_size=48, camera=camera)
    assert (frames.width, frames.height, frames.source_size) == (48, 32, (WIDTH, HEIGHT))
    assert np.allclose(frames.K, [[100, 0, 25], [0, 105, 15], [0, 0, 1]])
    with Image.open(frame_paths(tmp_path / "out", frames)[0]) as image:
        assert image.size == (48, 32)
    assert frames.focal_known


def test_exif_turns_pictures_and_knows_the_lens(tmp_path: Path) -> None:
    place = tmp_path / "phone"
    place.mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying on its side: turn clockwise to show
    exif.get_ifd(0x8769)[0xA405] = 26
    for t in range(4):
        lying = Image.fromarray(np.ascontiguousarray(np.rot90(picture(t))))
        lying.save(place / f"{t}.jpg", exif=exif, quality=95)
    frames = extract(place, tmp_path / "out")
    assert (frames.width, frames.height) == (WIDTH, HEIGHT)
    assert [red(path) for path in frame_paths(tmp_path / "out", frames)] == list(range(4))
    assert frames.K[0, 0] == pytest.approx(26 / 43.27 * np.hypot(WIDTH, HEIGHT), rel=1e-3)
    assert "26 mm" in frames.camera


def write_rotated(path: Path, count: int) -> None:
    """A video stored lying on its side whose header says to turn it clockwise by 90 degrees."""
    write_video(path, [np.ascontiguousarray(np.rot90(picture(t))) for t in range(count)], 25)
    data = bytearray(path.read_bytes())
    header = data.index(b"tkhd")
    assert data[header + 4] == 0
    matrix = (0, 1 << 16, 0, -(1 << 16), 0, 0, HEIGHT << 16, 0, 1 << 30)
    data[header + 44 : header + 80] = struct.pack(">9i", *matrix)
    path.write_bytes(data)


def test_a_video_is_set_upright(tmp_path: Path) -> None:
    pytest.importorskip("av")
    write_rotated(tmp_path / "phone.mp4", 6)
    frames = extract(tmp_path / "phone.mp4", tmp_path / "out")
    assert (frames.width, frames.height, frames.fps) == (WIDTH, HEIGHT, 25.0)
    assert frames.names[3] == "000003.png"
    found = [red(path) for path in frame_paths(tmp_path / "out", frames)]
    assert np.abs(np.subtract(found, range(6))).max() <= 1


def test_a_video_with_a_plain_header_is_left_as_it_is(tmp_path: Path) -> None:
    pytest.importorskip("av")
    write_video(tmp_path / "plain.mp4", [picture(t) for t in range(5)], 30)
    frames = extract(tmp_path / "plain.mp4", tmp_path / "out", stride=1)
    assert (frames.width, frames.height) == (WIDTH, HEIGHT)
    with Image.open(frame_paths(tmp_path / "out", frames)[0]) as image:
        assert np.asarray(image)[10, 10, 0] > np.asarray(image)[10, 10, 1] + 60


def test_colmap_gives_the_camera(folder: Path, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    size = {"width": 2 * WIDTH, "height": 2 * HEIGHT}
    camera = pycolmap.Camera(model="PINHOLE", params=[300.0, 310.0, 90.0, 70.0], camera_id=1, **size)
    model.add_camera(camera)
    (tmp_path / "sparse").mkdir()
    model.write(str(tmp_path / "sparse"))
    frames = extract(folder, tmp_path / "out", camera=CameraRequest(colmap=tmp_path / "sparse"))
    assert np.allclose(frames.K, [[150, 0, 45], [0, 155, 35], [0, 0, 1]])
    assert "COLMAP" in frames.camera and frames.focal_known


def arctic_images(root: Path, view: int = 2, size: tuple[int, int] = (2 * WIDTH, 2 * HEIGHT)) -> Path:
    """A folder of images as the release has it, of which view 2's camera has focal length 320."""
    folder = root / "images" / "s01" / "box_grab_01" / str(view)
    folder.mkdir(parents=True)
    for t in range(4):
        Image.fromarray(picture(t)).save(folder / f"{t:05d}.jpg")
    K = np.array([[320.0, 0.0, 97.0], [0.0, 322.0, 65.0], [0.0, 0.0, 1.0]])
    intrinsics = [(np.diag([1 + 0.1 * i, 1 + 0.1 * i, 1]) @ K).tolist() for i in range(-1, 7)]
    (root / "meta").mkdir()
    meta = {"s01": {"ioi_offset": 0, "image_size": [list(size)] * 9, "intris_mat": intrinsics}}
    (root / "meta" / "misc.json").write_text(json.dumps(meta))
    return folder


def test_images_of_arctic_bring_their_camera(tmp_path: Path) -> None:
    folder = arctic_images(tmp_path / "arctic")
    frames = extract(folder, tmp_path / "out")
    assert np.allclose(frames.K, [[160, 0, 48.5], [0, 161, 32.5], [0, 0, 1]])
    assert frames.focal_known and "misc.json" in frames.camera
    assert extract(folder, tmp_path / "out", camera=CameraRequest(focal=99.0)).K[0, 0] == 99.0


def test_other_folders_have_no_camera_of_arctic(tmp_path: Path) -> None:
    egocentric = arctic_images(tmp_path / "arctic", view=0)
    assert not extract(egocentric, tmp_path / "out").focal_known
    odd = arctic_images(tmp_path / "odd", size=(WIDTH, WIDTH))
    with pytest.raises(InputError, match="expected a camera with the proportions of 96 x 64, found 96 x 96"):
        extract(odd, tmp_path / "out")
    (tmp_path / "odd" / "meta" / "misc.json").write_text('{"s02": {}}')
    with pytest.raises(InputError, match=r"misc.json: s01: expected"):
        extract(odd, tmp_path / "out")


def test_4k_is_shrunk_unless_it_is_to_be_kept(tmp_path: Path) -> None:
    folder = tmp_path / "4k"
    folder.mkdir()
    for t in range(4):
        Image.fromarray(picture(t)).resize((3840, 2160)).save(folder / f"{t}.jpg")
    small = extract(folder, tmp_path / "small", camera=CameraRequest(focal=4000.0))
    assert (small.width, small.height, small.source_size) == (1280, 720, (3840, 2160))
    assert small.K[0, 0] == pytest.approx(4000 / 3)
    whole = extract(folder, tmp_path / "whole", camera=CameraRequest(focal=4000.0), max_size=0)
    assert (whole.width, whole.height, whole.K[0, 0]) == (3840, 2160, 4000.0)


@pytest.mark.parametrize(
    ("name", "before", "after", "words"),
    [
        (
            "cameras.txt",
            "300",
            "-300",
            "camera: expected a size and positive focal lengths, found 96 x 64 and -300",
        ),
        ("cameras.txt", "300", "nan", "expected a COLMAP model"),
        ("cameras.txt", "PINHOLE", "PINBALL", "expected a COLMAP model"),
        ("cameras.bin", "", "\x09", "cameras.bin: expected a whole file, found that it ends within entry 0"),
    ],
)
def test_a_colmap_camera_that_took_no_picture(
    folder: Path, tmp_path: Path, name: str, before: str, after: str, words: str
) -> None:
    model = tmp_path / "sparse"
    model.mkdir()
    files = {"cameras.txt": "1 PINHOLE 96 64 300 300 48 32\n", "images.txt": "", "points3D.txt": ""}
    for file, content in files.items():
        (model / file).write_text(content)
    (model / name).write_text(files.get(name, "").replace(before, after, 1))
    with pytest.raises(InputError) as caught:
        extract(folder, tmp_path / "out", camera=CameraRequest(colmap=model))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stride": 5}, "expected at least 4 frames, found 2 of 10 pictures"),
        ({"stride": 0}, "stride: expected an integer of at least 1, found 0"),
        ({"fps": 0.0}, "fps: expected a positive number, found 0"),
        ({"fps": float("nan")}, "fps: expected a positive number, found nan"),
        ({"camera": CameraRequest(focal=-3.0)}, "focal: expected a positive number"),
        ({"camera": CameraRequest(focal=1e300)}, "focal: expected a positive number"),
        ({"camera": CameraRequest(K=(1e300, 100, 50, 10))}, "positive focal lengths"),
        ({"camera": CameraRequest(focal=3.0, K=(1, 1, 1, 1))}, "expected one of K, focal and colmap"),
        ({"camera": CameraRequest(K=(100, 100, 500, 10))}, "the centre within 96 x 64"),
        ({"camera": CameraRequest(colmap=Path("nowhere"))}, "nowhere: expected the folder of a COLMAP model"),
    ],
)
def test_what_makes_no_sense_is_refused(
    folder: Path, tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError) as caught:
        extract(folder, tmp_path / "out", **options)
    assert words in str(caught.value)
    assert not (tmp_path / "out" / "frames.json").exists()


def test_bad_sources_are_told_in_a_sentence(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("av")
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    for path, words in [
        (tmp_path / "none.mp4", "expected a video file or a folder of images, found nothing"),
        (tmp_path / "text.mp4", "expected a readable video"),
        (tmp_path / "empty", "expected images"),
    ]:
        with pytest.raises(InputError, match=words):
            open_source(path)
    Image.fromarray(picture(0)[:40]).save(folder / "shot3.png")
    with pytest.raises(
        InputError, match=r"shot3.png: expected 96 x 64 pixels as in the first frame, found 96 x 40"
    ):
        extract(folder, tmp_path / "out")
    (folder / "shot1.png").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"shot1.png: expected a readable image"):
        open_source(folder)


def test_without_pyav_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mp4").write_bytes(b"")
    real = builtins.__import__

    def refuse(name: str, *rest: Any) -> Any:
        if name == "av":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match=r"bigs\[video\]"):
        open_source(tmp_path / "a.mp4")


def test_the_digest_follows_pictures_and_options(folder: Path) -> None:
    def digest(**options: Any) -> str:
        return frame_inputs(open_source(folder), FrameConfig(**options))

    first = digest()
    assert first == digest() != digest(stride=2)
    Image.fromarray(picture(9)).save(folder / "shot1.png")
    assert digest() != first


def test_what_is_a_source_and_what_a_clip(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "clip" / "build").mkdir(parents=True)
    (tmp_path / "clip" / "build" / "data.npy").write_bytes(b"")
    assert is_source(folder) and is_source(Path("video.MP4"))
    assert not is_source(tmp_path / "clip") and not is_source(tmp_path / "clip" / "build")
    assert not is_source(tmp_path / "nothing")
