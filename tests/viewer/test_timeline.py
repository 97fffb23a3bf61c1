"""The bars that say when hands hold the object."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from bigs.viewer.timeline import timeline


def test_bars_lie_where_their_frames_are() -> None:
    drawn = ET.fromstring(timeline({"right <b>": [(0, 30, 1.0), (45, 60, 0.5)], "left": []}, 60))
    assert [text.text for text in drawn.iter("text")] == ["right <b>", "left", "frame 0", "frame 59"]
    whole, first, second, _ = drawn.iter("rect")
    width = float(whole.get("width"))
    assert float(first.get("width")) == 0.5 * width
    assert float(second.get("x")) - float(whole.get("x")) == 0.75 * width
    assert float(first.get("fill-opacity")) > float(second.get("fill-opacity"))
    assert second.find("title").text == "frames 45 to 59, 50% certain"
