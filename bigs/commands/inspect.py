"""What a clip holds, before anything is fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bigs.data.hold import load_hold


def describe_clip(path: Path) -> list[tuple[str, str]]:
    """Facts about a clip as rows of text.

    Raises:
        InputError: the clip is not as it should be.
    """
    clip = load_hold(path)
    K = clip.K
    rows = [
        ("clip", f"{clip.name} ({clip.folder})"),
        ("frames", f"{len(clip)}, {clip.width} x {clip.height}"),
        ("camera", f"fx {K[0, 0]:.1f}, fy {K[1, 1]:.1f}, cx {K[0, 2]:.1f}, cy {K[1, 2]:.1f} pixels"),
    ]
    for entity, areas in clip.mask_areas.items():
        valid = clip.object.valid if entity == "object" and clip.object else None
        if entity in clip.hands:
            valid = clip.hands[entity].valid
        if valid is None:
            rows.append((entity, "absent"))
            continue
        shown = areas > 0
        share = 100.0 * areas[shown].mean() / (clip.width * clip.height) if shown.any() else 0.0
        text = f"visible in {int(shown.sum())} frames, {share:.1f} % of the image, "
        text += f"estimated in {int(valid.sum())}"
        if entity == "object" and clip.object:
            text += f", {len(clip.object.points)} points"
        rows.append((entity, text))
    positions = [hand.transl for hand in clip.hands.values()]
    if clip.object is not None:
        positions.append(clip.object.points_world().mean(axis=1))
    to_cam = clip.cam_from_world
    depths = [np.einsum("tj,tj->t", to_cam[:, 2, :3], position) + to_cam[:, 2, 3] for position in positions]
    middle = np.median(np.concatenate(depths))
    rows.append(("distance", f"{middle:.2f} m, where a pixel covers {1e3 * middle / K[0, 0]:.1f} mm"))
    return rows
