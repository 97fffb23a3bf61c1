"""Solid textures: colour as a function of a point on the surface. Enough print and grain to track. Metres."""

from __future__ import annotations

import numpy as np


def solid_noise(points: np.ndarray, cell: float, seed: int) -> np.ndarray:
    """Smooth random numbers [N] in [-1, 1] that vary over about `cell` metres."""
    scaled = points / cell
    base = np.floor(scaled).astype(np.int64)
    t = scaled - base
    t = t * t * (3 - 2 * t)
    sides = (1 - t).T, t.T
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        i, j, k = corner
        total += sides[i][0] * sides[j][1] * sides[k][2] * _hash(base + corner, seed)
    return total


def _hash(cells: np.ndarray, seed: int) -> np.ndarray:
    """A number in [-1, 1] for each integer cell [N, D]; the same on every machine."""
    mixed = np.full(len(cells), (seed * 0x9E3779B1) & 0xFFFFFFFF, dtype=np.uint64)
    for column in cells.T:
        mixed = (mixed ^ (column & 0xFFFF).astype(np.uint64)) * np.uint64(0x2C1B3C6D) & np.uint64(0xFFFFFFFF)
        mixed ^= mixed >> np.uint64(13)
    mixed = mixed * np.uint64(0x297A2D39) & np.uint64(0xFFFFFFFF)
    mixed ^= mixed >> np.uint64(15)
    return mixed.astype(np.float64) / 0x7FFFFFFF - 1.0


def _lettering(u: np.ndarray, v: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Where rows of letter-like marks lie, bool [N]; u to the right, v up, letters `size` metres high."""
    row = np.floor(v / (1.5 * size))
    in_row = v / (1.5 * size) - row
    column = np.floor(u / (0.8 * size))
    in_column = u / (0.8 * size) - column
    strokes = np.stack([row, column, np.floor(in_row * 4.5), np.floor(in_column * 4)], axis=1)
    ink = _hash(strokes.astype(np.int64), seed) > -0.1
    word = _hash(np.stack([row, np.floor((column + 3 * row) / 5)], axis=1).astype(np.int64), seed + 1) > -0.5
    return ink & word & (in_row < 0.67) & (in_column < 0.75)


def _disc(u: np.ndarray, v: np.ndarray, center: tuple[float, float], radius: float) -> np.ndarray:
    return np.hypot(u - center[0], v - center[1]) < radius


def _paint(colors: np.ndarray, where: np.ndarray, color: tuple[float, float, float]) -> None:
    colors[where] = color


def _grain(points: np.ndarray, colors: np.ndarray, amount: float, seed: int) -> np.ndarray:
    fine = solid_noise(points, 0.004, seed) + 0.7 * solid_noise(points, 0.011, seed + 1)
    return np.clip(colors * (1 + amount * fine[:, None]), 0, 1)


def card_print(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """A printed carton: another picture on each face, [N, 3]."""
    scaled = points / half
    face = np.abs(scaled).argmax(axis=1)
    positive = np.take_along_axis(scaled, face[:, None], axis=1)[:, 0] > 0
    u = np.where(face == 0, points[:, 1], points[:, 0]) * np.where(positive, 1, -1)
    v = np.where(face == 2, points[:, 1], points[:, 2])
    side = 2 * face + positive
    colors = np.tile([0.93, 0.9, 0.82], (len(points), 1))
    for index, (ground, band, ink) in enumerate(_CARD_COLORS):
        here = side == index
        _paint(colors, here & (v < 0.012), ground)
        _paint(colors, here & (np.abs(v - 0.012) < 0.003), band)
        large = _lettering(u - 0.002, v - 0.03, 0.022, 20 + index) & (v > 0.02) & (v < 0.08)
        small = _lettering(u, v, 0.007, 40 + index) & (v < -0.03) & (v > -0.08)
        _paint(colors, here & large, ink)
        _paint(colors, here & small, ink)
        _paint(colors, here & _disc(u, v, (0.008 * (-1) ** index, -0.012), 0.013), band)
        _paint(colors, here & _disc(u, v, (0.008 * (-1) ** index, -0.012), 0.008), (0.97, 0.95, 0.9))
    return _grain(points, colors, 0.05, 3)


_CARD_COLORS = (  # (ground, band, ink) of the faces -x, +x, -y, +y, -z, +z
    ((0.86, 0.62, 0.12), (0.75, 0.12, 0.1), (0.12, 0.15, 0.45)),
    ((0.15, 0.45, 0.62), (0.9, 0.75, 0.1), (0.1, 0.12, 0.2)),
    ((0.9, 0.72, 0.1), (0.1, 0.2, 0.55), (0.7, 0.1, 0.12)),
    ((0.2, 0.5, 0.3), (0.85, 0.3, 0.1), (0.15, 0.1, 0.35)),
    ((0.8, 0.78, 0.7), (0.3, 0.3, 0.3), (0.2, 0.2, 0.2)),
    ((0.85, 0.3, 0.2), (0.95, 0.9, 0.8), (0.2, 0.2, 0.5)),
)


def label_print(points: np.ndarray) -> np.ndarray:
    """A coloured bottle with a wrapped paper label and a ribbed cap, [N, 3]."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    u, v = 0.034 * angle, points[:, 2]
    colors = np.tile([0.16, 0.5, 0.42], (len(points), 1))
    _paint(colors, (np.floor((v + 0.4 * u) / 0.006) % 3 == 0) & (v > 0.046), (0.3, 0.66, 0.5))
    label = (v > -0.085) & (v < 0.043)
    _paint(colors, label, (0.94, 0.91, 0.8))
    _paint(colors, label & (np.abs(v - 0.036) < 0.004), (0.8, 0.2, 0.12))
    _paint(colors, label & (np.abs(v + 0.079) < 0.004), (0.8, 0.2, 0.12))
    _paint(colors, label & _lettering(u, v - 0.002, 0.017, 7) & (v > 0.003) & (v < 0.03), (0.1, 0.16, 0.42))
    _paint(colors, label & _lettering(u, v, 0.006, 9) & (v > -0.072) & (v < -0.032), (0.2, 0.18, 0.16))
    for index, around in enumerate((-0.075, -0.025, 0.03, 0.08)):
        spot = ((0.9, 0.55, 0.1), (0.3, 0.55, 0.15), (0.75, 0.15, 0.25), (0.2, 0.35, 0.7))[index]
        _paint(colors, label & _disc(u, v, (around, -0.014), 0.012), spot)
        _paint(colors, label & _disc(u, v, (around + 0.003, -0.011), 0.005), (0.96, 0.93, 0.85))
    cap = v > 0.08
    _paint(colors, cap, (0.82, 0.24, 0.14))
    _paint(colors, cap & (np.floor(angle * 12 / np.pi) % 2 == 0) & (v < 0.1), (0.62, 0.14, 0.1))
    return _grain(points, colors, 0.05, 5)


def rubber_and_paint(points: np.ndarray) -> np.ndarray:
    """A power tool: orange housing, dark ribbed grip, plates with print, [N, 3]."""
    x, y, z = points.T
    colors = np.tile([0.88, 0.36, 0.1], (len(points), 1))
    grip = (z < 0.036) & (z > -0.072)
    _paint(colors, grip, (0.17, 0.17, 0.19))
    _paint(colors, grip & (np.floor(z / 0.006) % 2 == 0) & (np.abs(x) > 0.009), (0.3, 0.3, 0.32))
    _paint(colors, grip & (x > 0.012) & (z > 0.008), (0.75, 0.13, 0.1))
    _paint(colors, (x > 0.076), (0.24, 0.25, 0.27))
    _paint(
        colors, (x > 0.076) & (np.floor(np.arctan2(y, z - 0.066) * 8 / np.pi) % 2 == 0), (0.42, 0.42, 0.44)
    )
    plate = (np.abs(y) > 0.019) & (x > -0.03) & (x < 0.062) & (z > 0.05) & (z < 0.084)
    _paint(colors, plate, (0.93, 0.9, 0.84))
    _paint(colors, plate & _lettering(x * np.sign(y), z - 0.004, 0.016, 13) & (z > 0.055), (0.12, 0.12, 0.14))
    _paint(colors, (z > 0.086) & (np.floor((x + y) / 0.012) % 2 == 0), (0.15, 0.15, 0.16))
    foot = z < -0.074
    _paint(colors, foot & (np.floor((x - y) / 0.01) % 2 == 0), (0.22, 0.22, 0.24))
    _paint(colors, foot & (z < -0.096) & _lettering(x, y, 0.01, 17), (0.95, 0.8, 0.2))
    return _grain(points, colors, 0.06, 11)


def skin_tone(rest: np.ndarray, nail: np.ndarray) -> np.ndarray:
    """Skin with blotches and fine creases, [N, 3].

    Args:
        rest: [N, 3] points in the hand's rest pose.
        nail: [N] in [0, 1], how much of a fingernail the point is.
    """
    base = np.array([0.83, 0.6, 0.49])
    blotch = solid_noise(rest, 0.016, 21)[:, None] * np.array([0.05, 0.075, 0.08])
    fine = solid_noise(rest, 0.0045, 22)[:, None] * np.array([0.035, 0.045, 0.045])
    creases = np.maximum(0, np.abs(solid_noise(rest * [1.0, 0.4, 0.4], 0.008, 23)) - 0.72)[:, None] * -0.35
    skin = base * (1 + blotch + fine + creases)
    return np.clip(skin * (1 - nail[:, None]) + np.array([0.93, 0.74, 0.68]) * nail[:, None], 0, 1)


def fingernails(
    rest: np.ndarray, tips: np.ndarray, last_joints: np.ndarray, thumb_up: float = 0.6
) -> np.ndarray:
    """How much of a fingernail each point is, [N] in [0, 1].

    Args:
        rest: [N, 3] points in the rest pose of a MANO hand, palm down.
        tips: [5, 3] fingertips, thumb first.
        last_joints: [5, 3] the outermost joint of each finger.
        thumb_up: how far the thumb's nail is turned from straight up to the thumb's side.
    """
    nail = np.zeros(len(rest))
    for index, (tip, joint) in enumerate(zip(tips, last_joints, strict=True)):
        bone = (tip - joint) / np.linalg.norm(tip - joint)
        up = np.array([0.0, 1.0, thumb_up if index == 0 else 0.0])
        up -= (up @ bone) * bone
        up /= np.linalg.norm(up)
        from_tip = rest - tip
        along, above = from_tip @ bone, from_tip @ up
        aside = np.linalg.norm(from_tip - along[:, None] * bone - above[:, None] * up, axis=1)
        inside = 1 - np.hypot((along + 0.006) / 0.006, aside / 0.0048)
        nail = np.maximum(nail, np.where(above > 0.0015, np.clip(4 * inside, 0, 1), 0))
    return nail
