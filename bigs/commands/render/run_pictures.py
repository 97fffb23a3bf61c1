"""The pictures of a finished run: contact sheet, video, and the report around them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bigs.checks import InputError
from bigs.commands.folder.contents import PREVIEW_PICTURE, PREVIEW_VIDEO, REPORT
from bigs.commands.render.frame import orbit_camera, render_frame, render_input_view
from bigs.data.base import Clip
from bigs.geometry.spread import spread
from bigs.metrics.picture import ALL_METRICS
from bigs.models.playback import Playback
from bigs.threads import beside
from bigs.train.fit_report import FitReport
from bigs.viewer.coverage import coverage_map
from bigs.viewer.preview import contact_sheet, overlay, save_picture, to_bytes, write_video
from bigs.viewer.report import write_report
from bigs.viewer.timeline import timeline

# Degrees by which the novel view is turned about the scene.
_NOVEL_VIEW = 40.0
# Number of frames under the report's slider, and width of each of the three pictures: about two megabytes.
_SLIDER_FRAMES, _SLIDER_WIDTH = 60, 320
# The object counts as hidden below this share of its usual area in the masks.
_HIDDEN = 0.1


@dataclass(frozen=True)
class Told:
    """Facts about a run besides its pictures."""

    table: Sequence[Sequence[str]]  # scores; the first row is the heading
    per_frame: Mapping[str, np.ndarray]  # score -> [T]
    log: Sequence[Mapping[str, Any]]
    report: FitReport
    times: Callable[[], Mapping[str, float]]  # seconds by part, read when everything else is drawn


@dataclass(frozen=True)
class Drawn:
    """Pictures of a run, for its report."""

    sheet: Image.Image
    frames: list[tuple[str, Image.Image]]  # caption, and input, render and novel view side by side
    video: Path | None
    skipped: tuple[str, ...]  # what was not drawn, and why


def draw_pictures(out: Path, clip: Clip, playback: Playback) -> Drawn:
    """Write preview.png, and preview.mp4 where PyAV is there."""
    sheet = _sheet(clip, playback)
    save_picture(out / PREVIEW_PICTURE, sheet)
    kept: list[tuple[str, Image.Image]] = []
    strips = _ahead(_strips(clip, playback, kept))
    try:
        write_video(out / PREVIEW_VIDEO, strips, playback.fps)
    except InputError as missing:
        for _ in strips:
            pass
        return Drawn(sheet, kept, None, (f"{PREVIEW_VIDEO}: {missing}",))
    return Drawn(sheet, kept, out / PREVIEW_VIDEO, ())


def write_run_report(out: Path, clip: Clip, playback: Playback, drawn: Drawn, told: Told) -> None:
    """Write report.html; what was not drawn is added to the report's skipped."""
    told.report.skipped.extend(drawn.skipped)
    write_report(
        out / REPORT,
        title=f"{clip.name}: {len(clip)} frames",
        facts={
            "frames": f"{len(clip)}, {clip.width} x {clip.height}",
            "subjects": ", ".join(playback.entities),
            "Gaussians": str(playback.gaussians([0]).means.shape[1]),
            **told.report.facts,
        },
        pictures={"input, render, render over input, turned": drawn.sheet},
        frames=drawn.frames,
        video=drawn.video,
        metrics=told.table,
        per_frame=_errors(told.per_frame),
        grasps=grasp_timeline(playback),
        coverage=_coverage(clip, playback),
        log=[
            {"stage": e["stage"], "step": e["step"], "loss": e["loss"], **e["terms"]}
            for e in told.log
            if e["event"] == "step"
        ],
        timings=told.times,
        skipped=told.report.skipped,
    )


def _sheet(clip: Clip, playback: Playback) -> Image.Image:
    frames = spread(len(clip), 6).tolist()
    rows: dict[str, list[np.ndarray]] = {"input": [], "render": [], "overlay": [], "turned 40°": []}
    for t in frames:
        color, alpha = render_input_view(playback, t)
        images = (clip.image(t), color, overlay(color, alpha, clip.image(t)), _novel_view(playback, t))
        for name, image in zip(rows, images, strict=True):
            rows[name].append(image)
    return contact_sheet(rows, [f"frame {t}" for t in frames])


def _strips(clip: Clip, playback: Playback, kept: list[tuple[str, Image.Image]]) -> Iterator[np.ndarray]:
    """Input, render and novel view side by side, frame by frame; smaller ones of some are added to `kept`."""
    wanted = set(spread(len(clip), _SLIDER_FRAMES).tolist())
    for t in range(len(clip)):
        parts = (clip.image(t), render_input_view(playback, t)[0], _novel_view(playback, t))
        strip = np.concatenate([to_bytes(part) for part in parts], axis=1)
        if t in wanted:
            width = min(3 * _SLIDER_WIDTH, strip.shape[1])
            height = max(1, round(strip.shape[0] * width / strip.shape[1]))
            small = Image.fromarray(strip).resize((width, height), Image.Resampling.LANCZOS)
            kept.append((f"frame {t} ({clip.frame_names[t]}): input, render, turned 40°", small))
        yield strip


def _ahead(items: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """The same items, each made while the one before is used."""
    with beside() as pool:
        coming = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


def _coverage(clip: Clip, playback: Playback) -> tuple[str, Image.Image] | None:
    if playback.object is None:
        return None
    obj = playback.object
    # The camera is at the origin of its own space.
    to_camera = -(obj.rotations.transpose(1, 2) @ obj.centers[..., None])[..., 0]
    areas = clip.mask_areas["object"]
    usual = np.median(areas[areas > 0]) if (areas > 0).any() else 1.0
    found = coverage_map(to_camera.numpy(), areas > _HIDDEN * usual)
    caption = (
        "directions in which the object's surface may face: blue was in view (darker: more often), red was "
        "never; dots are the camera's positions"
    )
    return caption, found.picture


def grasp_timeline(playback: Playback) -> str:
    """When each hand holds the object, as an SVG element; nothing where there is no object or no hand."""
    if playback.object is None or not playback.hands:
        return ""
    return timeline({side: hand.grasps() for side, hand in playback.hands.items()}, len(playback))


def _novel_view(playback: Playback, frame: int) -> np.ndarray:
    viewmat = orbit_camera(playback, frame, _NOVEL_VIEW)
    return render_frame(playback, frame, viewmat, playback.K, playback.width, playback.height)[0]


def _errors(per_frame: Mapping[str, np.ndarray]) -> dict[str, list[float]]:
    """The scores that are drawn as curves, under readable names."""
    named = {}
    for key, values in per_frame.items():
        metric = ALL_METRICS[key]
        if not metric.detail:
            named[f"{metric.paper} ({metric.unit})" if metric.unit else metric.paper] = values.tolist()
    return named
