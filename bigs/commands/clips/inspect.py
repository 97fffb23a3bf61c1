"""What a clip holds, before anything is fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bigs.commands.clips.open import open_clip
from bigs.data.formats.layouts import LAYOUT_NAMES, layout_of
from bigs.hand import load_hand_models


def describe_clip(path: Path, hand_model: Path | None = None) -> list[tuple[str, str]]:
    """Facts about a clip as rows of text.

    Args:
        path: a clip of any layout.
        hand_model: folder or file of MANO-format models; None takes the built-in hand.

    Raises:
        InputError: the clip is invalid.
    """
    clip = open_clip(path, load_hand_models(hand_model))
    K = clip.K
    rows = [
        ("clip", f"{clip.name} ({clip.folder})"),
        ("layout", LAYOUT_NAMES[layout_of(path)]),
        ("frames", f"{len(clip)}, {clip.width} x {clip.height}, {clip.fps:.3g} a second"),
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
        text = f"{'annotated' if clip.annotated else 'estimated'} in {int(valid.sum())}"
        if clip.mask_paths:
            text = f"visible in {int(shown.sum())} frames, {share:.1f} % of the image, {text}"
        if entity == "object" and clip.object:
            text += f", {len(clip.object.points)} points"
        rows.append((entity, text))
    if clip.annotated:
        rows.append(("tracks", "ground truth: they score a reconstruction (--gt) and do not start one"))
    if not clip.mask_paths:
        rows.append(("masks", "none"))
    positions = [hand.transl for hand in clip.hands.values()]
    if clip.object is not None:
        positions.append(clip.object.points_world().mean(axis=1))
    to_cam = clip.cam_from_world
    depths = [np.einsum("tj,tj->t", to_cam[:, 2, :3], position) + to_cam[:, 2, 3] for position in positions]
    middle = np.median(np.concatenate(depths))
    rows.append(("distance", f"{middle:.2f} m, where a pixel covers {1e3 * middle / K[0, 0]:.1f} mm"))
    rows += [("note", note) for note in clip.notes]
    return rows
