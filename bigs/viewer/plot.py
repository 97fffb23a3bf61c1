"""A line plot as a small inline SVG, without a plotting library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

_WIDTH, _HEIGHT = 360, 200
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 8, 24, 26
# More points are not visible at this width.
_MAX_POINTS = 400
# Beyond this ratio a linear axis would hide the end of a loss curve.
_LOG_RATIO = 20.0


def line_plot(
    title: str,
    x: Sequence[float],
    y: Sequence[float],
    borders: Sequence[tuple[float, str]] = (),
) -> str:
    """An SVG element showing y over x, with a logarithmic axis where positive values span more than 20 times.

    Args:
        title: written above.
        x: positions, ascending.
        y: values; those that are not finite leave a gap.
        borders: positions of vertical lines, each with the name of what begins there.
    """
    finite = [value for value in y if math.isfinite(value)]
    if not finite:
        return ""
    logarithmic = min(finite) > 0.0 and max(finite) / min(finite) > _LOG_RATIO
    to_axis = math.log10 if logarithmic else float
    low, high = to_axis(min(finite)), to_axis(max(finite))
    if high - low <= 1e-12 * max(1.0, abs(high)):
        low, high = low - 0.5 * max(abs(low), 1e-6), high + 0.5 * max(abs(high), 1e-6)
    first, last = x[0], max(x[-1], x[0] + 1e-9)

    def across(value: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (value - first) / (last - first)

    def down(value: float) -> float:
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (high - to_axis(value)) / (high - low)

    bottom = _HEIGHT - _BOTTOM
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">',
        f'<text x="{_LEFT}" y="15" class="name">{escape(title)}{" (log)" if logarithmic else ""}</text>',
        f'<path class="axis" d="M{_LEFT} {_TOP}V{bottom}H{_WIDTH - _RIGHT}"/>',
    ]
    for fraction in (0.0, 0.5, 1.0):
        level = low + fraction * (high - low)
        value = 10.0**level if logarithmic else level
        height = bottom - fraction * (bottom - _TOP)
        parts.append(f'<text x="{_LEFT - 5}" y="{height + 4:.1f}" text-anchor="end">{value:.3g}</text>')
        parts.append(f'<path class="grid" d="M{_LEFT} {height:.1f}H{_WIDTH - _RIGHT}"/>')
    for value, anchor in ((first, "start"), (last, "end")):
        place = f'x="{across(value):.1f}" y="{_HEIGHT - 8}" text-anchor="{anchor}"'
        parts.append(f"<text {place}>{value:.6g}</text>")
    for position, name in borders:
        left = across(min(max(position, first), last))
        line = f"M{left:.1f} {_TOP}V{bottom}"
        parts.append(f'<path class="border" d="{line}"><title>{escape(name)}</title></path>')
    step = max(1, math.ceil(len(y) / _MAX_POINTS))
    kept = [*range(0, len(y) - 1, step), len(y) - 1]
    curve, pen_down = [], False
    for index in kept:
        if math.isfinite(y[index]):
            curve.append(f"{'L' if pen_down else 'M'}{across(x[index]):.1f} {down(y[index]):.1f}")
        pen_down = math.isfinite(y[index])
    parts.append(f'<path class="curve" d="{"".join(curve)}"/></svg>')
    return "".join(parts)
