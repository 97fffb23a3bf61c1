"""Hands and object in one metric space: the object's size and the hands' depth, from where they touch.

HOLD fits hand, object, and both together by gradient descent. Structure from motion leaves one unknown, the
object's size, which moves it along the viewing rays and leaves its picture alone; a hand estimate is right
across the ray and wrong by centimetres along it. So all that is left is a line search over the size, and for
each size the best path of each hand along its rays, which dynamic programming finds exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bigs.checks import InputError
from bigs.data.base import HandTrack
from bigs.data.touching import masks_touch
from bigs.geometry.arrays import float32
from bigs.geometry.distance import DistanceField
from bigs.geometry.surface import inlier_points
from bigs.hand import HandModel
from bigs.preprocess.artefacts import USUAL_DEPTH_SIGMA, Alignment, ObjectSfm
from bigs.preprocess.hands.tracks import posed_track
from bigs.preprocess.object.rough_surface import SurfaceConfig, rough_surface, sights
from bigs.types import Side


@dataclass(frozen=True)
class AlignConfig:
    """The search and what it minimises, in metres."""

    # Sizes to try: factors on the first guess, evenly spaced in their logarithm; then as many steps between
    # the neighbours of the best.
    span: float = 0.3
    sizes: int = 13
    finer: int = 7
    # Cost, in touching frames, of a size that differs from the first guess by a share of `size_sigma`; grows
    # with the square. It decides where contact tells nothing.
    size_prior: float = 0.02
    size_sigma: float = 0.05
    # Shifts along the ray to try in every frame, as a share of the hand's depth.
    reach: float = 0.1
    shifts: int = 41
    # A hand that touches in the image has this many vertices near the surface; distances saturate at this.
    nearest: int = 30
    saturation: float = 0.01
    # Vertices deeper than `depth` count with this weight.
    penetration: float = 2.0
    depth: float = 0.003
    # Weights of a shift's square in units of `shift_sigma`, and of its change between frames in units of
    # `change_sigma`, both shares of the depth. Beyond about `shift_outlier` sigmas a shift costs little more.
    # Where hands are where they should be, contact is no reason to move them.
    shift_sigma: float = USUAL_DEPTH_SIGMA
    shift_outlier: float = 3.0
    change_sigma: float = 0.005
    shift_weight: float = 0.1
    # Mask pixels of hand and object that are this near each other touch.
    touch_pixels: int = 3
    # Use every Nth vertex.
    every: int = 2
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)


class AlignReport(NamedTuple):
    """The result of the search for the size."""

    touching: dict[Side, np.ndarray]  # [T] bool: masks of hand and object meet
    factors: np.ndarray  # [C] sizes, as factors on the first guess
    costs: np.ndarray  # [C] mean cost of a touching frame at the best shifts
    shifts: dict[Side, np.ndarray]  # [T] metres along the ray
    notes: tuple[str, ...]


def align(
    hands: Mapping[Side, HandTrack],
    sfm: ObjectSfm,
    masks: np.ndarray,
    K: np.ndarray,
    hand_models: Mapping[Side, HandModel],
    config: AlignConfig,
) -> tuple[Alignment, AlignReport]:
    """Find the object's size and correct the hands' depth.

    Args:
        hands: tracks in the camera frame, metres; at least one.
        sfm: the object's poses and points in an arbitrary unit.
        masks: [T, H, W] labels of `bigs.types.MASK_VALUES`.
        K: [3, 3] intrinsics.
        hand_models: each side's own model.
        config: see there.

    Returns:
        The alignment, and how it came about. Without a frame in which hand and object touch, the hands are
        left alone and the object is put at their depth.

    Raises:
        InputError: there is no hand to take the size from.
    """
    if not hands:
        raise InputError("alignment: expected at least one hand to measure the object by, found none")
    verts = {side: posed_vertices(track, hand_models[side]) for side, track in hands.items()}
    touching = {
        side: np.array([masks_touch(labels, side, config.touch_pixels) for labels in masks])
        & track.valid
        & (sfm.confidence > 0)
        for side, track in hands.items()
    }
    guess = first_scale(verts, touching, hands, sfm)
    points = guess * sfm.points
    points = points[inlier_points(points)]
    seen = sights(points, sfm.rotations, guess * sfm.transl, sfm.confidence, masks, K, config.surface)
    surface = rough_surface(points, seen, config.surface)
    outer, solid = DistanceField(surface.outer), DistanceField(surface.solid)
    factors = np.exp(np.linspace(-config.span, config.span, config.sizes))
    frames = sum(int(t.sum()) for t in touching.values())
    if frames == 0:
        transl = {side: track.transl for side, track in hands.items()}
        none = {side: np.zeros(len(masks)) for side in hands}
        note = (
            "hand and object never touch in the masks, so the object's size is guessed from the hands' depth"
        )
        report = AlignReport(touching, factors, np.zeros(len(factors)), none, (note,))
        return _alignment(guess, sfm, transl), report
    rays = {
        side: points.mean(1) / np.linalg.norm(points.mean(1), axis=1)[:, None]
        for side, points in verts.items()
    }

    def attempt(factor: float) -> tuple[float, dict[Side, np.ndarray]]:
        """The mean cost of a touching frame at that size, and each hand's shifts [T]."""
        cost, shifts = config.size_prior * (np.log(factor) / config.size_sigma) ** 2, {}
        for side, points in verts.items():
            table, tried = contact_costs(
                points[:, :: config.every],
                rays[side],
                touching[side],
                (sfm.rotations, guess * sfm.transl),
                (outer, solid),
                factor,
                config,
            )
            least, path = cheapest_path(table, config)
            cost += least / frames
            shifts[side] = tried[np.arange(len(path)), path]
        return cost, shifts

    coarse = {float(factor): attempt(float(factor)) for factor in factors}
    best = min(coarse, key=lambda factor: coarse[factor][0])
    step = 2.0 * config.span / (config.sizes - 1)
    fine = np.exp(np.log(best) + np.linspace(-step, step, config.finer + 2)[1:-1])
    tried = coarse | {float(factor): attempt(float(factor)) for factor in fine if factor not in coarse}
    factors = np.array(sorted(tried))
    costs = np.array([tried[float(factor)][0] for factor in factors])
    factor = float(factors[costs.argmin()])
    shifts = tried[factor][1]
    transl = {side: track.transl + shifts[side][:, None] * rays[side] for side, track in hands.items()}
    notes = []
    if abs(np.log(factor)) > config.span - step:
        notes.append("the object's size is at the end of the search range: check the hands' size and depth")
    report = AlignReport(touching, factors, costs, shifts, tuple(notes))
    return _alignment(guess * factor, sfm, transl), report


def _alignment(scale: float, sfm: ObjectSfm, hand_transl: dict[Side, np.ndarray]) -> Alignment:
    return Alignment(scale, sfm.rotations, scale * sfm.transl, sfm.valid, hand_transl)


def posed_vertices(track: HandTrack, model: HandModel) -> np.ndarray:
    """Vertices [T, V, 3] of a track in the camera frame, metres."""
    return posed_track(track, model).vertices.double().numpy()


def first_scale(
    verts: Mapping[Side, np.ndarray],
    touching: Mapping[Side, np.ndarray],
    hands: Mapping[Side, HandTrack],
    sfm: ObjectSfm,
) -> float:
    """Metres per unit that put the object's middle at the depth of the hands that touch it, in the median."""
    depth = (sfm.rotations @ np.median(sfm.points, axis=0) + sfm.transl)[:, 2]
    ratios: list[np.ndarray] = []
    for side, points in verts.items():
        use = touching[side] if any(t.any() for t in touching.values()) else hands[side].valid
        ratios.append(np.median(points[use, :, 2], axis=1) / depth[use])
    return float(np.median(np.concatenate(ratios)))


def contact_costs(
    verts: np.ndarray,
    rays: np.ndarray,
    touching: np.ndarray,
    poses: tuple[np.ndarray, np.ndarray],
    surfaces: tuple[DistanceField, DistanceField],
    factor: float,
    config: AlignConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """The cost of each shift of a hand along its ray in each frame, for an object `factor` times as large.

    Args:
        verts: [T, V, 3] of the hand, camera frame.
        rays: [T, 3] unit.
        touching: [T] bool; in the other frames only shifts cost.
        poses: rotations [T, 3, 3] and translations [T, 3] of the object at factor 1.
        surfaces: the object's at factor 1, in its own frame: what a hand touches, and what it is never in.
        factor: on size and depth together.
        config: see there.

    Returns:
        Costs [T, S], and the shifts [T, S] in metres.
    """
    rotations, transl = poses
    depth = np.median(verts[:, :, 2], axis=1)
    shares = np.linspace(-config.reach, config.reach, config.shifts)
    shifts = depth[:, None] * shares
    squares = (shares / config.shift_sigma) ** 2
    costs = np.tile(
        config.shift_weight * squares / (1.0 + squares / config.shift_outlier**2), (len(verts), 1)
    )
    count = min(max(config.nearest // config.every, 1), verts.shape[1])
    for t in np.flatnonzero(touching):
        at = (verts[t] @ rotations[t]) / factor - transl[t] @ rotations[t]
        along = rays[t] @ rotations[t] / factor
        places = float32(at + shifts[t][:, None, None] * along)
        outside, inside = (factor * surface(places).numpy() for surface in surfaces)
        near = np.partition(outside, count - 1, axis=1)[:, :count].clip(0.0)
        deep = (-inside - config.depth).clip(0.0, 0.02) / config.saturation
        costs[t] += (near / (near + config.saturation)).mean(1) + config.penetration * deep.mean(1)
    return costs, shifts


def cheapest_path(costs: np.ndarray, config: AlignConfig) -> tuple[float, np.ndarray]:
    """The choice [T] of one column a frame with the least sum of `costs` [T, S] and of squared changes."""
    shares = np.linspace(-config.reach, config.reach, costs.shape[1])
    change = config.shift_weight * ((shares[:, None] - shares) / config.change_sigma) ** 2
    total = costs[0].copy()
    came = np.zeros(costs.shape, dtype=int)
    for t in range(1, len(costs)):
        options = total[:, None] + change
        came[t] = options.argmin(0)
        total = options.min(0) + costs[t]
    path = np.empty(len(costs), dtype=int)
    path[-1] = total.argmin()
    for t in range(len(costs) - 1, 0, -1):
        path[t - 1] = came[t, path[t]]
    return float(total.min()), path
