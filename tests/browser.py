"""A real Chromium, driven by Playwright, for what only a browser can say."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image

# WebGL without a graphics card.
_FLAGS = (
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
)


@contextmanager
def open_page(width: int = 720, height: int = 420) -> Iterator[Any]:
    """A page of a headless browser; the test is skipped where there is no browser."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra 'browser'")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on the search path (chromium, chromium-browser or google-chrome)")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(_FLAGS))
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            # A slow machine is no failure; what never comes to pass is one after so many pictures, below.
            page.set_default_timeout(0)
            yield page
        finally:
            browser.close()


def picture(page: Any, clip: dict[str, int] | None = None) -> np.ndarray:
    """What the page shows, [H, W, 3] int."""
    shot = page.screenshot(clip=clip) if clip else page.screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def until(
    page: Any,
    condition: Callable[[np.ndarray], bool],
    clip: dict[str, int] | None = None,
    pictures: int = 600,
) -> np.ndarray:
    """The first picture of which `condition` holds; the page draws each anew, the slower the machine."""
    for _ in range(pictures):
        now = picture(page, clip)
        if condition(now):
            return now
    raise AssertionError("the page never shows what is waited for")


def changed(a: np.ndarray, b: np.ndarray) -> int:
    """Number of pixels that differ visibly."""
    return int((np.abs(a - b).max(axis=-1) > 24).sum())
