"""The report is one well-formed file that asks for nothing outside itself."""

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bigs.checks import InputError
from bigs.viewer.plot import line_plot
from bigs.viewer.report import replace_scores, write_report

VOID = {"meta", "img", "br", "input"}


class Page(HTMLParser):
    """Every tag closed in order, every text and attribute kept."""

    def __init__(self, document):
        super().__init__()
        self.open, self.tags, self.text, self.attributes = [], [], [], []
        self.feed(document)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def plain(level):
    return Image.fromarray(np.full((20, 60, 3), level, np.uint8))


@pytest.fixture
def report(tmp_path):
    video = tmp_path / "preview.mp4"
    video.write_bytes(b"not really a video")
    log = [
        {"stage": "hands", "step": s, "terms": {"mask": 1.0 / (s + 1), "rgb": 0.5}} for s in range(0, 50, 10)
    ]
    log += [{"stage": "joint", "step": s, "loss": 2.0, "note": "ignored", "done": True} for s in (0, 10)]
    write_report(
        tmp_path / "report.html",
        title="mustard <b> & co",
        facts={"preset": "fast"},
        pictures={"input & render": Image.fromarray(np.full((20, 30, 3), 90, np.uint8))},
        video=video,
        frames=[(f"frame {t}", plain(40 * t)) for t in range(5)],
        per_frame={"MPJPE (mm)": [5.0, float("nan"), 7.0], "nothing": [float("nan")] * 3},
        coverage=("half of it", plain(7)),
        metrics=[("score", "unit", "initial", "result"), ("MPJPE_r", "mm", "21.25", "9.10")],
        log=log,
        timings={"hands": 30.0, "joint": 10.0},
        skipped=["contact: no frame shows touch"],
    )
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def test_everything_is_in_it(report):
    page = Page(report)
    text = " ".join(page.text)
    for wanted in (
        *("mustard <b> & co", "preset", "fast", "MPJPE_r", "21.25", "9.10", "input & render"),
        *("30.0", "75 %", "40.0", "contact: no frame shows touch"),
        *("frame 0", "MPJPE (mm)", "half of it"),
    ):
        assert wanted in text, wanted
    assert "b" not in page.tags
    # mask, rgb and loss are numbers; notes and flags are not. One score of each frame is a number.
    assert page.tags.count("svg") == 4
    assert "ignored" not in text


def test_it_asks_for_nothing_outside_itself(report):
    sources = [
        value for _, name, value in Page(report).attributes if name in ("src", "href", "data", "poster")
    ]
    assert len(sources) == 1 + 5 + 1 + 2  # sheet, frames, map, video and what stands for it
    assert all(source.startswith("data:") for source in sources)
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", report)
    assert "@import" not in report
    assert "url(" not in report


def test_picture_and_video_are_whole(report):
    sources = dict(re.findall(r'src="data:([a-z0-9/]+);base64,([^"]*)"', report))
    shown = re.findall(r'class="frame" src="data:image/jpeg;base64,([^"]*)" alt="[^"]*"( hidden)?', report)
    assert [bool(hidden) for _, hidden in shown] == [False, True, True, True, True]
    levels = [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))).mean() for data, _ in shown]
    assert levels == pytest.approx([0, 40, 80, 120, 160], abs=2)
    assert base64.b64decode(sources["video/mp4"]) == b"not really a video"
    assert base64.b64decode(sources["image/jpeg"])[:3] == b"\xff\xd8\xff"


def test_an_empty_report_has_only_its_title(tmp_path):
    write_report(tmp_path / "report.html", title="nothing yet")
    page = Page((tmp_path / "report.html").read_text())
    assert "h2" not in page.tags
    assert "table" not in page.tags


def test_a_missing_video_leaves_no_report(tmp_path):
    with pytest.raises(InputError, match="expected a video for the report, found no such file"):
        write_report(tmp_path / "report.html", title="x", video=tmp_path / "gone.mp4")
    assert list(tmp_path.iterdir()) == []


def curve_points(svg):
    path = re.search(r'class="curve" d="([^"]*)"', svg).group(1)
    return [tuple(map(float, point.split())) for point in re.split("[ML]", path)[1:]]


def test_a_plot_runs_from_corner_to_corner():
    points = curve_points(line_plot("loss", [0, 5, 10], [1.0, 2.0, 3.0]))
    assert points == [(56.0, 174.0), (204.0, 99.0), (352.0, 24.0)]


def test_a_plot_of_many_decades_is_logarithmic():
    svg = line_plot("loss", [0, 1, 2], [100.0, 1.0, 0.01])
    assert "loss (log)" in svg
    assert curve_points(svg)[1][1] == pytest.approx(99.0)
    assert "(log)" not in line_plot("loss", [0, 1], [-1.0, 100.0])


def test_hard_values_plot_without_trouble():
    svg = line_plot("loss", [0, 1, 2, 3, 4], [1.0, float("nan"), 2.0, float("inf"), 3.0])
    assert svg.count("M", svg.index('class="curve"')) == 3
    assert "nan" not in svg
    assert len(curve_points(line_plot("flat", [0, 1], [0.0, 0.0]))) == 2
    assert line_plot("none", [0, 1], [float("nan")] * 2) == ""
    long = curve_points(line_plot("long", list(range(10_000)), [float(v) for v in range(10_000)]))
    assert len(long) <= 402
    assert long[-1] == (352.0, 24.0)


def test_scores_that_come_later_take_the_place_of_earlier_ones(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(
        path, title="run", metrics=[("score", "result"), ("F10", "1.00")], timings=lambda: {"fit": 2.0}
    )
    assert replace_scores(path, [("score", "initial", "result"), ("F10", "7.00", "9.00")])
    text = path.read_text()
    assert text.count("Scores</h2>") == 1
    assert "<td>9.00</td>" in text and "<td>1.00</td>" not in text and "<td>2.0</td>" in text
    path.write_text("<html>of another version</html>")
    assert not replace_scores(path, [("score", "result")])
