"""`report.html`: one file with pictures, video, scores, curves and timings, that opens without a network."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from numbers import Real
from pathlib import Path
from typing import Any

from PIL import Image

from bigs.atomic import atomic_write
from bigs.checks import InputError
from bigs.viewer.plot import line_plot

_JPEG_QUALITY = 88
# JPEG's limit for a side.
_JPEG_SIDE = 65500
# JPEG quality of the pictures under the slider, of which there are many.
_FRAME_QUALITY = 75
# Keys of a log row that locate it and are not curves.
_POSITION_KEYS = ("stage", "step", "steps", "time")

# The scores between these marks may be replaced later.
_SCORES = ("<!-- scores -->", "<!-- end of scores -->")

_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.6em; } h2 { font-size: 1.2em; margin-top: 2em; }
img, video { max-width: 100%; height: auto; }
figure { margin: 1em 0; } figcaption { opacity: .75; }
table { border-collapse: collapse; } th, td { padding: .2em .9em; border-bottom: 1px solid #8886; }
td { text-align: right; font-variant-numeric: tabular-nums; } th { text-align: right; }
th:first-child, td:first-child { text-align: left; }
#time { width: 100%; } .frame { width: 100%; }
.curves { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 1em; }
svg text { font: 10px system-ui, sans-serif; fill: currentColor; }
svg .name { font-weight: bold; font-size: 12px; }
svg path { fill: none; } svg .axis { stroke: currentColor; } svg .grid { stroke: #8883; }
svg .border { stroke: #888; stroke-dasharray: 3 3; } svg .curve { stroke: #2a7de1; stroke-width: 1.5; }
"""

_SLIDER_SCRIPT = """<script>
{
  const slider = document.getElementById("time"), moment = document.getElementById("moment");
  const frames = [...document.querySelectorAll(".frame")];
  slider.addEventListener("input", () => {
    frames.forEach((frame, index) => { frame.hidden = index !== slider.valueAsNumber; });
    moment.textContent = frames[slider.valueAsNumber].alt;
  });
  // Browsers keep a slider where it was when a page is loaded again.
  slider.value = 0;
}
</script>"""


def write_report(
    path: str | Path,
    *,
    title: str,
    facts: Mapping[str, str] | None = None,
    pictures: Mapping[str, Image.Image] | None = None,
    frames: Sequence[tuple[str, Image.Image]] = (),
    video: str | Path | None = None,
    metrics: Sequence[Sequence[str]] = (),
    per_frame: Mapping[str, Sequence[float]] | None = None,
    grasps: str = "",
    coverage: tuple[str, Image.Image] | None = None,
    log: Sequence[Mapping[str, Any]] = (),
    timings: Mapping[str, float] | Callable[[], Mapping[str, float]] | None = None,
    skipped: Sequence[str] = (),
) -> None:
    """Write the report; `path` is whole or absent. Parts that are empty are left out.

    Args:
        path: the .html file.
        title: its heading.
        facts: what the run was: name -> value.
        pictures: caption -> picture.
        frames: caption -> picture of each time that the slider goes through.
        video: an .mp4 file, embedded as it is.
        metrics: a table of text, the first row its heading, as `bigs.metrics.report.comparison_table` makes
            it.
        per_frame: name -> one number a frame; those that are not finite leave a gap.
        grasps: when hands hold the object, an SVG element as `bigs.viewer.timeline` makes it.
        coverage: what it shows -> the map of directions from which the object was seen.
        log: rows in the order they were logged: "stage" (text, optional), "step" (steps done in that stage),
            and numbers; dictionaries of numbers count as numbers of their own. Every number becomes a curve
            over all stages; what is neither is passed over.
        timings: name -> seconds, or a function that is asked for them when all else is done.
        skipped: what was not done, one sentence each with its reason.

    Raises:
        InputError: there is no such video.
    """
    parts = [f"<h1>{escape(title)}</h1>"]
    if facts:
        parts.append(_table([("", ""), *facts.items()]))
    for caption, picture in (pictures or {}).items():
        parts.append(_figure(caption, picture))
    parts.append(_scores(metrics))
    if frames:
        parts.append(_slider(frames))
    if video is not None:
        if not Path(video).is_file():
            raise InputError(f"{video}: expected a video for the report, found no such file")
        source = _embedded(Path(video).read_bytes(), "video/mp4")
        # Browsers may show nothing before a video plays.
        first = _embedded(_jpeg(frames[0][1], _FRAME_QUALITY), "image/jpeg") if frames else ""
        poster = f' poster="{first}"' if first else ""
        parts.append(f'<h2>Video</h2><video controls loop muted{poster} src="{source}"></video>')
    errors = [line_plot(name, range(len(y)), y) for name, y in (per_frame or {}).items()]
    if any(errors):
        parts.append(f'<h2>Errors frame by frame</h2><div class="curves">{"".join(errors)}</div>')
    if grasps:
        parts.append(f"<h2>When hands hold the object</h2>{grasps}")
    if coverage is not None:
        caption, picture = coverage
        parts += ["<h2>Where the object was seen from</h2>", _figure(caption, picture)]
    curves = _curves(log)
    if curves:
        parts.append(f'<h2>Optimisation</h2><div class="curves">{"".join(curves)}</div>')
    if timings:
        seconds = timings() if callable(timings) else timings
        parts += ["<h2>Time</h2>", _table(_timing_rows(seconds))]
    if skipped:
        parts.append(f"<h2>Skipped</h2><ul>{''.join(f'<li>{escape(line)}</li>' for line in skipped)}</ul>")
    body = "\n".join(parts)
    document = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head>\n<body>{body}</body></html>\n"
    )
    with atomic_write(path) as file:
        file.write(document.encode())


def replace_scores(path: Path, metrics: Sequence[Sequence[str]]) -> bool:
    """Replace the table of scores in a report; False if the report has none.

    Args:
        path: a file of `write_report`.
        metrics: as there.
    """
    text = path.read_text(encoding="utf-8")
    before, opening, rest = text.partition(_SCORES[0])
    _, closing, after = rest.partition(_SCORES[1])
    if not (opening and closing):
        return False
    with atomic_write(path) as file:
        file.write(f"{before}{_scores(metrics)}{after}".encode())
    return True


def _scores(metrics: Sequence[Sequence[str]]) -> str:
    body = f"<h2>Scores</h2>{_table(metrics)}" if metrics else ""
    return f"{_SCORES[0]}{body}{_SCORES[1]}"


def _figure(caption: str, picture: Image.Image) -> str:
    name, source = escape(caption), _embedded(_jpeg(picture, _JPEG_QUALITY), "image/jpeg")
    return f'<figure><img src="{source}" alt="{name}"><figcaption>{name}</figcaption></figure>'


def _slider(frames: Sequence[tuple[str, Image.Image]]) -> str:
    """Pictures of which one is shown, and a slider that says which; the arrow keys move it, too."""
    pictures = "".join(
        f'<img class="frame" src="{_embedded(_jpeg(picture, _FRAME_QUALITY), "image/jpeg")}" '
        f'alt="{escape(caption)}"{" hidden" if index else ""}>'
        for index, (caption, picture) in enumerate(frames)
    )
    return (
        f"<h2>Frame by frame</h2><figure>{pictures}"
        f'<input id="time" type="range" min="0" max="{len(frames) - 1}" value="0" aria-label="frame">'
        f'<figcaption id="moment">{escape(frames[0][0])}</figcaption></figure>{_SLIDER_SCRIPT}'
    )


def _table(rows: Sequence[Sequence[str]]) -> str:
    """The first row as heading, left out when it is empty."""
    heading = "".join(f"<th>{escape(cell)}</th>" for cell in rows[0])
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows[1:])
    return f"<table>{f'<tr>{heading}</tr>' if any(rows[0]) else ''}{body}</table>"


def _timing_rows(timings: Mapping[str, float]) -> list[tuple[str, str, str]]:
    total = sum(timings.values())
    rows = [
        (name, f"{seconds:.1f}", f"{100.0 * seconds / max(total, 1e-9):.0f} %")
        for name, seconds in timings.items()
    ]
    return [("part", "seconds", "share"), *rows, ("all", f"{total:.1f}", "")]


def _curves(log: Sequence[Mapping[str, Any]]) -> list[str]:
    """One plot for every number that is logged twice or more, over the steps of all stages in a row."""
    positions: list[float] = []
    borders: list[tuple[float, str]] = []
    before, last, stage = 0.0, 0.0, None
    for index, row in enumerate(log):
        if row.get("stage") != stage:
            before, last, stage = before + last, 0.0, row.get("stage")
            borders.append((before, str(stage)))
        last = float(row.get("step", index + 1))
        positions.append(before + last)
    numbers = [_numbers(row) for row in log]
    names = dict.fromkeys(name for row in numbers for name in row)
    plots = []
    for name in names:
        known = [(x, row[name]) for x, row in zip(positions, numbers, strict=True) if name in row]
        if len(known) > 1:
            x, y = zip(*known, strict=True)
            plots.append(line_plot(name, x, y, borders[1:]))
    return [plot for plot in plots if plot]


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    found: dict[str, float] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            found |= {name: number for name, number in _numbers(value).items() if name not in found}
        elif isinstance(value, Real) and not isinstance(value, bool) and key not in _POSITION_KEYS:
            found[str(key)] = float(value) if math.isfinite(value) else math.nan
    return found


def _jpeg(picture: Image.Image, quality: int) -> bytes:
    buffer = io.BytesIO()
    picture = picture.convert("RGB")
    picture.thumbnail((_JPEG_SIDE, _JPEG_SIDE))
    picture.save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def _embedded(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
