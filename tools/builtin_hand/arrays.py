"""The built-in hand's arrays, from its anatomy.

Joint tree, axes and number of shapes as in a MANO-format file; no pose correctives, flat mean pose.
"""

from __future__ import annotations

import numpy as np

from bigs.hand.model import MANO_PARENTS
from tools.builtin_hand.anatomy import (
    FINGERS,
    WRIST,
    capsule_distance,
    chain_points,
    finger_capsules,
    finger_distance,
    from_wrist,
    hand_distance,
    palm_capsules,
    rest_joints,
)
from tools.builtin_hand.remesh import adjacency, implicit_mesh, remesh

# Edges on a finger and on the palm, metres: about ten vertices around a finger, about 1000 in all.
FINGER_EDGE = 0.0050
PALM_EDGE = 0.0080

# First bone of each finger in `FINGERS`, and the finger of each bone; the wrist (0) belongs to none.
FIRST_BONE = {name: 1 + 3 * i for i, name in enumerate(FINGERS)}
TIP_ORDER = ("thumb", "index", "middle", "ring", "pinky")


def right_hand_arrays() -> dict[str, np.ndarray]:
    """What `HandModel` takes, but for the correctives, of which there are none; in about a second."""
    margin = 0.006
    joints = rest_joints()
    tips = np.array([chain_points(finger)[3] for finger in FINGERS.values()])
    extent = np.concatenate([joints, tips, from_wrist(0.036, 0.0, 0.0)[None]])
    # Thicker than the flesh around any joint, thin beyond the tips.
    lower = extent.min(0) - np.array([margin, 0.022, 0.022])
    upper = extent.max(0) + np.array([margin, 0.022, margin])
    vertices, faces = implicit_mesh(hand_distance, lower, upper, step=0.0032)
    vertices, faces = remesh(vertices, faces, hand_distance, _edge_length)
    weights = _skinning_weights(vertices, faces)
    return {
        "v_template": vertices,
        "faces": faces,
        "shapedirs": _shape_directions(vertices, weights, joints),
        "J_regressor": _joint_regressor(vertices, weights, joints),
        "lbs_weights": weights,
        "hands_mean": np.zeros((len(MANO_PARENTS) - 1, 3)),
        "tip_vertex_ids": _tip_vertices(vertices),
    }


def _edge_length(points: np.ndarray) -> np.ndarray:
    """Fine on fingers, coarse on the palm, smooth between; metres."""
    from_finger = np.min([finger_distance(points, finger) for finger in FINGERS.values()], axis=0)
    return FINGER_EDGE + (PALM_EDGE - FINGER_EDGE) * _smooth_step(from_finger, 0.0, 0.012)


def _smooth_step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, with a continuous slope."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _bone_directions() -> np.ndarray:
    """Unit vectors [16, 3] along each bone, towards the tip; the wrist's own points along the palm."""
    directions = [np.array([-1.0, 0.0, 0.0])]
    for finger in FINGERS.values():
        bones = np.diff(chain_points(finger), axis=0)
        directions.extend(bones / np.linalg.norm(bones, axis=1, keepdims=True))
    return np.array(directions)


def _tip_vertices(vertices: np.ndarray) -> np.ndarray:
    """The vertex nearest to each fingertip, in the order thumb, index, middle, ring, pinky."""
    tips = np.array([chain_points(FINGERS[name])[3] for name in TIP_ORDER])
    return np.linalg.norm(vertices[None] - tips[:, None], axis=-1).argmin(axis=1)


def _skinning_weights(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Weights [V, 16]: along each finger a smooth hand-over at every joint, across fingers by distance."""
    weights = np.zeros((len(vertices), len(MANO_PARENTS)))
    membership = _finger_membership(vertices)
    for name, finger in FINGERS.items():
        points = chain_points(finger)
        bones = np.diff(points, axis=0)
        bones /= np.linalg.norm(bones, axis=1, keepdims=True)
        # How far past each joint a vertex lies, measured along the mean of the two bones that meet there; the
        # palm bends with the first bone over a longer stretch at the thumb's saddle joint.
        before = [bones[0], bones[0] + bones[1], bones[1] + bones[2]]
        past: list[np.ndarray] = []
        for joint, along, radius in zip(points, before, finger.radii, strict=False):
            reach = 0.75 * radius if name != "thumb" or len(past) else 1.2 * radius
            past.append(_smooth_step((vertices - joint) @ (along / np.linalg.norm(along)), -reach, reach))
        first, second, third = past[0], past[0] * past[1], past[0] * past[1] * past[2]
        share = (
            np.stack([1.0 - first, first - second, second - third, third], axis=1) * membership[name][:, None]
        )
        start = FIRST_BONE[name]
        weights[:, 0] += share[:, 0]
        weights[:, start : start + 3] += share[:, 1:]
    links = adjacency(faces, len(vertices))
    neighbours = np.bincount(links.indices, minlength=len(vertices))[:, None]
    for _ in range(2):
        weights = 0.5 * weights + 0.5 * (links @ weights) / neighbours
    weights[weights < 0.01] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


def _finger_membership(vertices: np.ndarray) -> dict[str, np.ndarray]:
    """How far each vertex [V] belongs to each finger, metacarpal included; sums to 1."""
    metacarpals = dict(zip(("index", "middle", "ring", "pinky"), palm_capsules()[3:7], strict=True))
    distance = {}
    for name, finger in FINGERS.items():
        capsules = finger_capsules(finger) + ([metacarpals[name]] if name in metacarpals else [])
        distance[name] = np.min([capsule_distance(vertices, capsule) for capsule in capsules], axis=0)
    nearest = np.min(list(distance.values()), axis=0)
    nearest_other = np.min([d for name, d in distance.items() if name != "thumb"], axis=0)
    # The web of the thumb stretches over centimetres; between fingers there is a gap.
    thumb = _smooth_step(nearest_other - distance["thumb"], -0.008, 0.008)
    share = {
        name: np.exp(-(((d - nearest) / 0.0025) ** 2)) for name, d in distance.items() if name != "thumb"
    }
    total = np.maximum(sum(share.values()), 1e-12)
    return {name: (1.0 - thumb) * s / total for name, s in share.items()} | {"thumb": thumb}


def _joint_regressor(vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Rows [16, V] that are non-negative, sum to 1, and give the rest joints exactly.

    Each row is a bell around the joint times exp(tilt . v), the tilt found by Newton's method: of all
    weightings whose mean is the joint, the one nearest to the bell in relative entropy.
    """
    rows = []
    for joint, parent in enumerate(MANO_PARENTS):
        offset = vertices - joints[joint]
        reach = 1.3 * np.sort(np.linalg.norm(offset, axis=1))[8]
        # Only the two bones that meet at the joint, so that a neighbouring finger has no say in it.
        owned = weights[:, joint] + (weights[:, parent] if parent >= 0 else 0.0)
        bell = owned * np.exp(-0.5 * ((offset / reach) ** 2).sum(1))
        scaled, tilt = offset / reach, np.zeros(3)
        for _ in range(30):
            row = bell * np.exp(scaled @ tilt)
            row /= row.sum()
            mean = row @ scaled
            spread = (scaled * row[:, None]).T @ scaled - np.outer(mean, mean)
            tilt -= np.linalg.solve(spread, mean)
        rows.append(row)
    return np.array(rows)


def _shape_directions(vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Ten ways in which hands differ [V, 3, 10], metres per unit.

    Every bone is stretched by a matrix about its own joint and carried along by its parent; the stretches are
    blended by the skinning weights. In order: size, finger length, palm width, thickness, finger girth, thumb
    length, index against ring and pinky length, palm length, pinky length, wrist girth.
    """
    bones = len(MANO_PARENTS)
    directions = _bone_directions()
    along = directions[:, :, None] * directions[:, None, :]
    across = np.eye(3) - along
    x, y, z = (np.diag(axis) for axis in np.eye(3))
    of = {name: np.isin(np.arange(bones), np.arange(3) + first) for name, first in FIRST_BONE.items()}
    palm = np.arange(bones) == 0
    long_fingers = of["index"] | of["middle"] | of["ring"] | of["pinky"]

    def on(which: np.ndarray, matrices: np.ndarray, amount: float) -> np.ndarray:
        return amount * which[:, None, None] * np.broadcast_to(matrices, (bones, 3, 3))

    stretches = [
        on(np.ones(bones, dtype=bool), np.eye(3), 0.040),
        on(long_fingers, along, 0.060),
        on(palm, z, 0.080) + on(long_fingers, z, 0.040),
        on(np.ones(bones, dtype=bool), y, 0.080) - on(~palm, y @ along, 0.080),
        on(~palm, across, 0.080),
        on(of["thumb"], along, 0.080),
        on(of["index"], along, 0.040) - on(of["ring"] | of["pinky"], along, 0.030),
        on(palm, x, 0.045),
        on(of["pinky"], along, 0.080),
    ]
    shapes = [_stretched(vertices, weights, joints, stretch) for stretch in stretches]
    girth = _smooth_step(vertices[:, 0], WRIST[0] - 0.035, WRIST[0] + 0.005)
    shapes.append(0.080 * (weights[:, 0] * girth)[:, None] * ((vertices - WRIST) * [0.0, 1.0, 1.0]))
    return np.stack(shapes, axis=-1)


def _stretched(
    vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray, stretch: np.ndarray
) -> np.ndarray:
    """Displacements [V, 3] of vertices under one small linear map [16, 3, 3] per bone."""
    carried = np.zeros((len(MANO_PARENTS), 3))
    for joint, parent in enumerate(MANO_PARENTS[1:], start=1):
        carried[joint] = carried[parent] + stretch[parent] @ (joints[joint] - joints[parent])
    per_bone = np.einsum("kij,vkj->vki", stretch, vertices[:, None] - joints) + carried
    return np.einsum("vk,vki->vi", weights, per_bone)
