"""The report of a real run in a real browser: the slider moves, and nothing is asked of a network."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from browser import changed, open_page, picture
from command_line import Run

pytestmark = pytest.mark.slow
HEADINGS = ("Scores", "Frame by frame", "Errors frame by frame", "Where the object was seen from", "Time")


def test_the_report_opens_offline_and_its_slider_moves(finished_run: Run) -> None:
    asked: list[str] = []
    failed: list[str] = []
    with open_page(900, 900) as page:
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: failed.append(str(error)))
        page.context.set_offline(True)
        page.goto((finished_run.folder / "report.html").as_uri())
        for heading in (
            "Scores",
            "Frame by frame",
            "Errors frame by frame",
            "Where the object was seen from",
        ):
            assert page.get_by_role("heading", name=heading, exact=True).count() == 1, heading
        # Every picture has been decoded.
        broken = "[...document.images].filter(i => !i.hidden && !(i.complete && i.naturalWidth > 0)).length"
        assert page.evaluate(broken) == 0

        first = frame(page)
        slide(page, 0.5)
        assert page.locator("#moment").inner_text().startswith(("frame 5 ", "frame 6 "))
        middle = frame(page)
        assert changed(first, middle) > 100
        page.keyboard.press("ArrowRight")
        assert page.locator("#moment").inner_text().startswith(("frame 6 ", "frame 7 "))
        slide(page, 0.0)
        assert changed(first, frame(page)) == 0
        assert page.locator(".frame:visible").count() == 1
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    assert failed == []


def frame(page: Any) -> np.ndarray:
    shown = page.locator(".frame:visible")
    shown.scroll_into_view_if_needed()
    return picture(page, shown.bounding_box())


def slide(page: Any, share: float) -> None:
    """Drag the slider with the mouse."""
    place = page.locator("#time").bounding_box()
    y = place["y"] + place["height"] / 2
    now = float(page.locator("#time").input_value()) / float(page.locator("#time").get_attribute("max"))
    # The thumb's middle goes from half its width to half its width before the end.
    at = [place["x"] + 8 + part * (place["width"] - 16) for part in (now, share)]
    page.mouse.move(at[0], y)
    page.mouse.down()
    page.mouse.move(at[1], y, steps=6)
    page.mouse.up()
