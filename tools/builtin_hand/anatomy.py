"""The built-in right hand as numbers and as an implicit surface: where bones run and how thick the flesh is.

Metres, in MANO's axes: fingers towards -x, thumb towards +z, palm facing -y. The sizes are those of an adult
hand of about 18 cm, rounded.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

WRIST = np.array([0.0957, 0.0064, 0.0062])


class Finger(NamedTuple):
    """One finger of the flat hand: a straight chain from its first joint."""

    base: tuple[float, float, float]  # knuckle; for the thumb the saddle joint at the wrist
    direction: tuple[float, float, float]  # of the first bone; need not be unit
    curl: float  # degrees of flexion added at each further joint in the rest pose
    lengths: tuple[float, float, float]  # lengths of the three bones, the last one to the skin of the tip
    radii: tuple[float, float, float, float]  # radii of the flesh at the three joints and at the tip


# In MANO's order: the pinky before the ring finger, the thumb last.
FINGERS: dict[str, Finger] = {
    "index": Finger(
        (0.0075, 0.0020, 0.0290),
        (-1.0, -0.01, 0.10),
        2.0,
        (0.0440, 0.0260, 0.0245),
        (0.0098, 0.0088, 0.0079, 0.0065),
    ),
    "middle": Finger(
        (0.0050, 0.0045, 0.0075),
        (-1.0, 0.0, 0.0),
        2.0,
        (0.0480, 0.0300, 0.0255),
        (0.0100, 0.0090, 0.0081, 0.0067),
    ),
    "pinky": Finger(
        (0.0225, -0.0025, -0.0300),
        (-1.0, -0.03, -0.24),
        3.0,
        (0.0350, 0.0205, 0.0215),
        (0.0084, 0.0075, 0.0068, 0.0056),
    ),
    "ring": Finger(
        (0.0120, 0.0025, -0.0125),
        (-1.0, -0.01, -0.10),
        2.0,
        (0.0450, 0.0275, 0.0250),
        (0.0094, 0.0084, 0.0076, 0.0063),
    ),
    "thumb": Finger(
        (0.0720, -0.0070, 0.0290),
        (-0.74, -0.30, 0.60),
        -3.0,
        (0.0430, 0.0340, 0.0280),
        (0.0135, 0.0108, 0.0098, 0.0074),
    ),
}


class Capsule(NamedTuple):
    """A tapered capsule: the points within a linearly changing radius of a segment."""

    start: np.ndarray
    end: np.ndarray
    start_radius: float
    end_radius: float


def from_wrist(x: float, y: float, z: float) -> np.ndarray:
    """The point [3] at an offset from the wrist joint."""
    return WRIST + np.array([x, y, z])


def chain_points(finger: Finger) -> np.ndarray:
    """The three joints and the tip [4, 3] of a finger."""
    direction = np.array(finger.direction) / np.linalg.norm(finger.direction)
    # Flexion turns about the axis that is parallel to the palm and perpendicular to the finger.
    axis = np.cross(direction, [0.0, -1.0, 0.0])
    axis /= np.linalg.norm(axis)
    points = [np.array(finger.base)]
    for length in finger.lengths:
        points.append(points[-1] + length * direction)
        angle = np.radians(finger.curl)
        direction = direction * np.cos(angle) + np.cross(axis, direction) * np.sin(angle)
    return np.array(points)


def rest_joints() -> np.ndarray:
    """The 16 joints [16, 3] in MANO order."""
    return np.concatenate([WRIST[None], *(chain_points(finger)[:3] for finger in FINGERS.values())])


@cache
def finger_capsules(finger: Finger) -> list[Capsule]:
    """The flesh of a finger's three bones; the last ends so that its round end reaches the tip."""
    points, radii = chain_points(finger), finger.radii
    last = points[3] - points[2]
    points[3] -= radii[3] * last / np.linalg.norm(last)
    return [Capsule(points[i], points[i + 1], radii[i], radii[i + 1]) for i in range(3)]


@cache
def palm_capsules() -> list[Capsule]:
    """Forearm stump, metacarpals, the pads under the knuckles, and the two muscles that frame the palm."""
    base = {name: np.array(finger.base) for name, finger in FINGERS.items()}
    carpus = {"index": 0.011, "middle": 0.003, "ring": -0.006, "pinky": -0.013}
    parts = [
        Capsule(from_wrist(0.020, -0.001, 0.011), from_wrist(-0.012, -0.001, 0.012), 0.0155, 0.0150),
        Capsule(from_wrist(0.020, -0.001, 0.000), from_wrist(-0.012, -0.001, 0.000), 0.0160, 0.0150),
        Capsule(from_wrist(0.020, -0.001, -0.011), from_wrist(-0.012, -0.001, -0.013), 0.0155, 0.0145),
    ]
    for name, across in carpus.items():
        radius = 0.0098 if name == "pinky" else 0.0108
        parts.append(
            Capsule(from_wrist(-0.012, -0.002, across), base[name] + [0.002, -0.003, 0.0], 0.0135, radius)
        )
    for first, second in (("index", "middle"), ("middle", "ring"), ("ring", "pinky")):
        shift = np.array([-0.005, -0.0035, 0.0])
        parts.append(Capsule(base[first] + shift, base[second] + shift, 0.0088, 0.0088))
    thumb = chain_points(FINGERS["thumb"])
    parts += [
        Capsule(thumb[0] + [0.004, -0.003, -0.008], thumb[1] + [0.008, -0.001, -0.010], 0.0160, 0.0120),
        Capsule(thumb[1] + [0.010, 0.006, -0.010], base["index"] + [0.024, -0.002, 0.0], 0.0070, 0.0080),
        Capsule(from_wrist(-0.016, -0.009, -0.021), base["pinky"] + [0.014, -0.005, -0.001], 0.0135, 0.0105),
    ]
    return parts


def capsule_distance(points: np.ndarray, capsule: Capsule) -> np.ndarray:
    """Signed distance [...] of points [..., 3] to a capsule, negative inside; exact if it does not taper."""
    bone = capsule.end - capsule.start
    relative = points - capsule.start
    along = np.clip(relative @ bone / (bone @ bone), 0.0, 1.0)
    radius = capsule.start_radius + along * (capsule.end_radius - capsule.start_radius)
    across = relative - along[..., None] * bone
    return np.sqrt(np.einsum("...i,...i", across, across)) - radius


def smooth_min(first: np.ndarray, second: np.ndarray, width: float) -> np.ndarray:
    """The smaller of two distances, rounded where they differ by less than `width` (a quadratic fillet)."""
    overlap = np.clip(1.0 - np.abs(first - second) / width, 0.0, None)
    return np.minimum(first, second) - 0.25 * width * overlap**2


def finger_distance(points: np.ndarray, finger: Finger) -> np.ndarray:
    """Signed distance [...] of points [..., 3] to one finger, without its metacarpal."""
    distances = [capsule_distance(points, capsule) for capsule in finger_capsules(finger)]
    return smooth_min(smooth_min(distances[0], distances[1], 0.002), distances[2], 0.002)


def hand_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance [...] of points [..., 3] to the hand's skin, metres; approximate away from it."""
    first, *others = palm_capsules()
    palm = capsule_distance(points, first)
    for capsule in others:
        palm = smooth_min(palm, capsule_distance(points, capsule), 0.012)
    hand = palm
    for finger in FINGERS.values():
        # Narrow enough that neighbouring fingers do not merge above the web.
        hand = smooth_min(hand, finger_distance(points, finger), 0.006)
    return hand
