"""A map of the directions from which an object was seen; the rest of it is a guess."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

# Surface counts as seen from directions within this angle of its normal; beyond, it is too slanted to
# reconstruct.
_WIDEST = 60.0
_RADIUS, _MARGIN, _CAPTION = 150, 14, 22
_PAPER, _INK, _UNSEEN, _CAMERA = (255, 255, 255), (20, 20, 20), (214, 96, 77), (20, 20, 20)
# Colours from seen once to seen most often.
_FEW, _MANY = np.array([222.0, 235.0, 247.0]), np.array([8.0, 81.0, 156.0])


class Coverage(NamedTuple):
    """How much of the sphere of directions was seen, and the picture."""

    share: float  # 0 to 1
    picture: Image.Image


def coverage_map(directions: np.ndarray, visible: np.ndarray) -> Coverage:
    """Map how often surface that faces each way was in view.

    The two discs are the halves of the sphere of normals, in equal-area projection: facing the object's +z
    and its -z. Blue was seen, the darker the more often; red never was. Dots are the cameras.

    Args:
        directions: [T, 3] from the object to the camera, in the object's own frame.
        visible: [T] bool: the object could be seen in that frame.
    """
    towards = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    towards = towards[visible]
    width, height = 4 * _RADIUS + 3 * _MARGIN, 2 * _RADIUS + 2 * _MARGIN + _CAPTION
    picture = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(14)
    seen: list[np.ndarray] = []
    for half, sign in enumerate((1.0, -1.0)):
        left, top = _MARGIN + half * (2 * _RADIUS + _MARGIN), _MARGIN
        normals, inside = _half_sphere(sign)
        counts = _counts(normals[inside], towards)
        seen.append(counts > 0)
        disc = np.full((*inside.shape, 3), _PAPER, dtype=np.uint8)
        disc[inside] = _shades(counts, max(len(towards), 1))
        picture.paste(Image.fromarray(disc), (left, top))
        for x, y in _places(towards[sign * towards[:, 2] >= 0], sign):
            at = (left + _RADIUS * (1 + x), top + _RADIUS * (1 - y))
            draw.ellipse((at[0] - 2, at[1] - 2, at[0] + 2, at[1] + 2), _CAMERA)
        name = f"facing {'+' if sign > 0 else '-'}z of the object"
        draw.text((left + _RADIUS, top + 2 * _RADIUS + _CAPTION / 2), name, _INK, font, anchor="mm")
    # In an equal-area projection all pixels weigh the same.
    return Coverage(float(np.concatenate(seen).mean()), picture)


def _half_sphere(sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Normals [S, S, 3] of the pixels of a disc and which of them are inside it [S, S]."""
    at = (np.arange(2 * _RADIUS) + 0.5) / _RADIUS - 1.0
    x, y = np.meshgrid(at, -at)
    square = x * x + y * y
    # Lambert's projection: the radius is sqrt(1 - |z|), which reaches 1 at the equator.
    z = 1.0 - square
    stretch = np.sqrt(np.maximum(2.0 - square, 0.0))
    return np.stack([sign * x * stretch, y * stretch, sign * z], axis=-1), square <= 1.0


def _places(directions: np.ndarray, sign: float) -> np.ndarray:
    """Where directions [N, 3] of a half lie on its disc, [N, 2] in -1 to 1."""
    radius = np.sqrt(np.maximum(1.0 - np.abs(directions[:, 2]), 0.0))
    flat = np.maximum(np.hypot(directions[:, 0], directions[:, 1]), 1e-12)
    return np.stack([sign * directions[:, 0], directions[:, 1]], axis=1) * (radius / flat)[:, None]


def _counts(normals: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """In how many frames each normal [N, 3] was in view, [N]."""
    return (normals @ towards.T >= np.cos(np.deg2rad(_WIDEST))).sum(axis=1)


def _shades(counts: np.ndarray, most: int) -> np.ndarray:
    share = np.sqrt(counts / most)[:, None]
    return np.where(counts[:, None] > 0, _FEW + share * (_MANY - _FEW), _UNSEEN).astype(np.uint8)
