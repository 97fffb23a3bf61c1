"""Takes the picture of `bigs view` that the README shows, from a finished run.

    python docs/viewer_picture.py RUN

It needs the extras `viewer` and `browser`, and a Chromium; no graphics card. The picture is what the page
shows in the middle of the clip, a little nearer than at first, in 256 colours so that it stays small.
"""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import tyro
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from bigs.checks import InputError
from bigs.commands.render.live import view

OUT = Path(__file__).with_name("viewer.png")
# WebGL without a graphics card.
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Milliseconds that the page gets to draw what it was told; without a graphics card that is slow.
REST = 8000
# Of the mouse wheel.
NEARER = -400


def main(
    run: tyro.conf.Positional[Path],
    out: Path = OUT,
    width: int = 1000,
    height: int = 620,
) -> None:
    """Serve the run, open the page, go to the middle of the clip, and keep what it shows.

    Args:
        run: a finished run.
        out: the picture.
        width: of the page, pixels.
        height: of the page, pixels.
    """
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise InputError(f"expected one of the programs {', '.join(BROWSERS)}, found none")
    with view(run, port=0) as viewer, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(FLAGS))
        page = browser.new_page(viewport={"width": width, "height": height})
        # Otherwise the page lowers its resolution when it finds the machine slow.
        page.goto(f"{viewer.url}/?fixedDpr=1")
        page.get_by_text("frames a second").wait_for(timeout=120_000)
        page.wait_for_timeout(REST)
        to_the_middle(page)
        page.mouse.move(0.35 * width, 0.55 * height)
        page.mouse.wheel(0, NEARER)
        page.wait_for_timeout(REST)
        shot = page.screenshot(timeout=120_000)
        browser.close()
    picture = Image.open(io.BytesIO(shot)).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    picture.save(out, optimize=True)
    print(f"{out}: {width} x {height}, {out.stat().st_size // 1000} kB")


def to_the_middle(page: Page) -> None:
    """Drag the frame slider to the middle of its track, and close the message about the graphics card."""
    notice = page.locator(".mantine-Notification-closeButton")
    if notice.count():
        notice.first.click()
    thumb, track = page.get_by_role("slider").first, page.locator(".mantine-Slider-track").first
    at, along = thumb.bounding_box(), track.bounding_box()
    assert at is not None and along is not None
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
    page.mouse.down()
    page.mouse.move(along["x"] + 0.5 * along["width"], at["y"] + at["height"] / 2, steps=8)
    page.mouse.up()


if __name__ == "__main__":
    tyro.cli(main)
