"""When hands hold the object: bars over the frames of a clip, as a small inline SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

_WIDTH, _ROW, _LEFT, _FOOT = 720, 22, 60, 18


def timeline(rows: Mapping[str, Sequence[tuple[int, int, float]]], frames: int) -> str:
    """An SVG element with one row of bars for each name.

    Args:
        rows: name -> bars (first frame, frame after the last, certainty in [0, 1]); a bar is the paler the
            less certain it is, and says its frames and certainty under the pointer.
        frames: of the whole clip.
    """
    scale = (_WIDTH - _LEFT - 8) / max(frames, 1)
    height = _ROW * len(rows) + _FOOT
    parts = [f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="grasps">']
    for index, (name, bars) in enumerate(rows.items()):
        top = _ROW * index
        parts.append(f'<text x="{_LEFT - 6}" y="{top + 15}" text-anchor="end">{escape(name)}</text>')
        parts.append(
            f'<rect x="{_LEFT}" y="{top + 3}" width="{scale * frames:.1f}" height="{_ROW - 6}" '
            'fill="#8882"></rect>'
        )
        for start, stop, certainty in bars:
            parts.append(
                f'<rect x="{_LEFT + scale * start:.1f}" y="{top + 3}" width="{scale * (stop - start):.1f}" '
                f'height="{_ROW - 6}" rx="3" fill="#2a7de1" fill-opacity="{0.2 + 0.8 * certainty:.2f}">'
                f"<title>frames {start} to {stop - 1}, {certainty:.0%} certain</title></rect>"
            )
    for frame, anchor in ((0, "start"), (frames - 1, "end")):
        place = _LEFT + scale * (frame + (anchor == "end"))
        parts.append(f'<text x="{place:.1f}" y="{height - 4}" text-anchor="{anchor}">frame {frame}</text>')
    return "".join(parts) + "</svg>"
