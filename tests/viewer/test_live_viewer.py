"""`bigs view` in a real browser: what is clicked and dragged changes the picture, and only as it should."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import changed, open_page, picture, until
from command_line import Answer, Run, assert_refused
from PIL import Image

from bigs.commands.folder.contents import load_run
from bigs.commands.render.frame import render_frame

pytestmark = pytest.mark.slow
pytest.importorskip("viser", reason="needs the extra 'viewer'")

# A message about the missing graphics card covers what is above, the panel what is to the right.
TOAST = 150
SCENE = {"x": 0, "y": TOAST, "width": 390, "height": 270}
RIGHT, LEFT, OBJECT = (225, 87, 89), (78, 121, 167), (237, 201, 72)


@pytest.fixture(scope="module")
def address(finished_run: Run, tiny_clip: Path) -> Iterator[str]:
    command = ["view", str(finished_run.folder), "--gt", str(tiny_clip / "gt.npz"), "--port", "0"]
    # What a shell starts in the background is deaf to interrupts, and so is all that it starts.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    server = subprocess.Popen(
        [sys.executable, "-u", "-m", "bigs.cli", *command], stdout=subprocess.PIPE, text=True
    )
    signal.signal(signal.SIGINT, before)
    assert server.stdout is not None
    line = server.stdout.readline()
    found = re.fullmatch(r"(http://127\.0\.0\.1:\d+) \(Ctrl-C ends\)\n", line)
    try:
        assert found is not None, line
        yield found[1]
    finally:
        server.send_signal(signal.SIGINT)
        # An interrupted viewer has done its work.
        assert server.wait() == 0
        server.stdout.close()


@pytest.fixture(scope="module")
def page(address: str) -> Iterator[Any]:
    with open_page() as page:
        # Otherwise the page lowers its resolution when it finds the machine slow.
        page.goto(f"{address}/?fixedDpr=1")
        page.get_by_text("frames a second").wait_for()
        page.wait_for_function("document.querySelector('canvas') !== null")
        until(page, lambda image: (image.sum(-1) < 600).sum() > 1500, SCENE)
        yield page


def box(page: Any, name: str) -> Any:
    return page.get_by_label(name, exact=True)


def near(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Pixels of a colour, however bright: the page shades meshes."""
    return int((np.abs(image - np.array(color)).max(axis=-1) < 30).sum())


def slide(page: Any, label: str, share: float) -> None:
    """Drag the thumb of a slider to a share of its track, with the mouse."""
    row = page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//*[@role='slider']][1]")
    thumb, track = row.get_by_role("slider"), row.locator(".mantine-Slider-track")
    thumb.hover()  # which waits until it has stopped moving, as where its folder unfolds
    at, along = thumb.bounding_box(), track.bounding_box()
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
    page.mouse.down()
    page.mouse.move(along["x"] + share * along["width"], at["y"] + at["height"] / 2, steps=8)
    page.mouse.up()


def frame_number(page: Any) -> int:
    return int(page.get_by_role("slider").first.get_attribute("aria-valuenow"))


def like(image: np.ndarray) -> Callable[[np.ndarray], bool]:
    return lambda now: changed(now, image) == 0


def unlike(image: np.ndarray, least: int = 200) -> Callable[[np.ndarray], bool]:
    return lambda now: changed(now, image) > least


def at_rest(page: Any) -> np.ndarray:
    """The picture once it stays; a slow page goes on reporting a drag for a while."""
    last = picture(page, SCENE)
    for _ in range(60):
        # Longer than it takes to draw once, also on a machine that does other things.
        began = time.monotonic()
        picture(page, SCENE)
        page.wait_for_timeout(1000 + 5000 * (time.monotonic() - began))
        now = picture(page, SCENE)
        if changed(now, last) == 0:
            return now
        last = now
    raise AssertionError("the page does not come to rest")


@pytest.fixture
def start(page: Any) -> np.ndarray:
    """The picture of the first frame, with everything as it was when the page opened."""
    return at_rest(page)


@pytest.mark.parametrize(
    ("name", "on"),
    [
        *((name, True) for name in ("right hand", "left hand", "object", "Gaussians", "input camera")),
        *((name, False) for name in ("meshes", "ground truth")),
    ],
)
def test_a_box_shows_or_hides(page: Any, start: np.ndarray, name: str, on: bool) -> None:
    box(page, name).set_checked(not on)
    until(page, unlike(start), SCENE)
    box(page, name).set_checked(on)
    until(page, like(start), SCENE)


def test_colours_by_subject(page: Any, start: np.ndarray) -> None:
    def pick(name: str) -> None:
        page.get_by_role("combobox").filter(visible=True).last.click()
        page.get_by_role("option", name=name).click()

    pick("by subject")
    until(page, lambda image: min(near(image, color) for color in (RIGHT, LEFT, OBJECT)) > 100, SCENE)
    box(page, "right hand").uncheck()
    until(page, lambda image: near(image, RIGHT) < 20 and near(image, LEFT) > 100, SCENE)
    box(page, "right hand").check()
    pick("as reconstructed")
    until(page, like(start), SCENE)
    assert min(near(start, color) for color in (RIGHT, LEFT, OBJECT)) < 20


def test_the_frame_slider(page: Any, start: np.ndarray) -> None:
    slide(page, "frame", 0.5)
    assert frame_number(page) in (5, 6)
    until(page, unlike(start), SCENE)
    slide(page, "frame", 0.0)
    assert frame_number(page) == 0
    until(page, like(start), SCENE)


def test_play_and_pause(page: Any, start: np.ndarray) -> None:
    box(page, "play").check()
    page.wait_for_function("document.querySelector('[role=slider]').ariaValueNow > 2")
    box(page, "play").uncheck()
    at_rest(page)
    slide(page, "frame", 0.0)
    until(page, like(start), SCENE)


@pytest.mark.parametrize(
    ("folder", "knob"),
    [("Pose right hand", "right hand: thumb"), ("Pose object", "object: turn about x")],
)
def test_fingers_bend_and_the_object_turns(page: Any, start: np.ndarray, folder: str, knob: str) -> None:
    page.get_by_text(folder, exact=True).click()
    page.get_by_text(knob, exact=True).scroll_into_view_if_needed()
    slide(page, knob, 0.9)
    until(page, unlike(start, 20), SCENE)
    bent = at_rest(page)
    # The other subjects are where they were.
    assert changed(bent, start) < 0.7 * (start.sum(-1) < 720).sum()
    page.get_by_text("reset poses").click()
    until(page, like(start), SCENE)
    page.get_by_text(folder, exact=True).click()


def test_through_the_input_camera_it_shows_what_the_engine_draws(page: Any, finished_run: Run) -> None:
    page.get_by_text("look through the input camera").click()
    playback = load_run(finished_run.folder)
    width, height = page.evaluate("(c => [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
    # The page keeps the vertical angle and has the optical axis in its middle.
    K = playback.K.clone()
    K[:2] *= height / playback.height
    K[0, 2], K[1, 2] = width / 2, height / 2
    _, alpha = render_frame(playback, 0, torch.eye(4), K, width, height)
    part = {"x": 0, "y": TOAST, "width": width, "height": height - TOAST}
    drawn = alpha[TOAST:] > 0.3

    def agrees(image: np.ndarray) -> bool:
        shown = image.sum(-1) < 700
        return bool((shown & drawn).sum() > 0.9 * (shown | drawn).sum())

    until(page, agrees, part)


def test_the_picture_of_the_readme_can_be_taken_again(page: Any, finished_run: Run, tmp_path: Path) -> None:
    """By the program that took it; `page` skips where there is no browser."""
    out = tmp_path / "viewer.png"
    script = Path(__file__).parents[2] / "docs" / "viewer_picture.py"
    command = [sys.executable, script, finished_run.folder, "--out", out, "--width", "640", "--height", "400"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "640 x 400" in done.stdout and out.stat().st_size < 300_000
    shown = np.asarray(Image.open(out).convert("RGB")).astype(int)[:, :320]
    skin = shown[..., 0] > shown[..., 2] + 30
    assert skin.sum() > 300


def test_an_address_of_another_machine_is_refused(call: Callable[..., Answer], finished_run: Run) -> None:
    answer = call("view", finished_run.folder, "--host", "203.0.113.1")
    assert_refused(answer, "203.0.113.1", "expected an address of this machine")


def test_it_listens_on_this_machine_only(address: str) -> None:
    port = int(address.rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port), timeout=5):
        pass
    with pytest.raises(OSError), socket.create_connection(("127.0.0.2", port), timeout=2):
        pass
