"""`make_clip`: a small clip of hands turning an object, with ground truth, from nothing but a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from scipy.spatial.transform import Rotation

from bigs.checks import InputError, check_choice
from bigs.data.base import HandTrack, ObjectTrack
from bigs.data.formats.hold import GL_FROM_CV, shift_before, write_hold
from bigs.data.ground_truth import write_ground_truth
from bigs.data.synthetic.estimates import HandGuess, ObjectGuess, guess_hand, guess_object
from bigs.data.synthetic.grasp import FINGERS, Grasp, HandLike, find_grasp, pose_hand, rest_joints
from bigs.data.synthetic.motion import HandMotion, carry_hand, frame_camera, turn_object
from bigs.data.synthetic.objects import (
    OBJECT_KINDS,
    ObjectKind,
    PointFunction,
    SolidObject,
    make_object,
    surface_normals,
)
from bigs.data.synthetic.raycast import Body, Picture, require_embree, take_picture
from bigs.data.synthetic.texture import fingernails, skin_tone
from bigs.geometry.mesh import face_areas, vertex_normals
from bigs.types import MASK_VALUES, SIDES, USUAL_FPS, Side

# A hand touches the object if its nearest vertex is no farther than this, metres.
CONTACT = 0.003
_SENSOR_NOISE = 1.3 / 255
# A point is visible if it is no farther behind the visible surface than this, metres.
_SEEN_WITHIN = 0.003
_SEEN_FRAMES = 3


def make_clip(
    folder: str | Path,
    *,
    hand_models: Mapping[Side, HandLike],
    frames: int = 24,
    width: int = 160,
    height: int = 120,
    seed: int = 0,
    hands: Sequence[Side] = SIDES,
    object: ObjectKind = "bottle",
    name: str | None = None,
) -> Path:
    """Write a clip in the layout of HOLD's `build` folder, with `gt.npz` and `gt_object.ply` beside it.

    Args:
        folder: where to; made if missing.
        hand_models: a model for each of `hands`.
        frames: length, at least 4.
        width, height: of the images, pixels.
        seed: the clip is a function of it and of the other arguments.
        hands: which hands hold the object.
        object: what they hold.
        name: of the sequence; made of object and seed if not given.

    Returns:
        `folder`.

    Raises:
        InputError: an unknown object or hand, too few frames or pixels, or embreex is not installed.
    """
    check_choice("synthetic clip: object", object, OBJECT_KINDS)
    for side in hands:
        check_choice("synthetic clip: hands", side, tuple(hand_models))
    if frames < 4 or width < 32 or height < 32:
        raise InputError(
            f"synthetic clip: expected at least 4 frames of 32 x 32, found {frames} of {width} x {height}"
        )
    require_embree()
    folder = Path(folder)
    streams = _Streams(seed)
    solid = make_object(object)
    betas = np.clip(0.5 * streams.shape.standard_normal(10), -1, 1)
    rotations, positions = turn_object(streams.motion, frames)
    grasps = {
        side: find_grasp(hand_models[side], betas, solid.places[side], solid.distance) for side in hands
    }
    extent = [_grasp_verts(hand_models[side], betas, grasp) for side, grasp in grasps.items()]
    K, shift = frame_camera(
        np.concatenate([solid.mesh.vertices, *extent]), rotations, positions, width, height
    )
    positions = positions + shift
    motions = {
        side: carry_hand(streams.carry[side], hand_models[side], betas, grasps[side], rotations, positions)
        for side in hands
    }
    pictures = _take_pictures(streams, solid, hand_models, motions, rotations, positions, K, (width, height))

    points = _seen_points(streams.points, solid, rotations, positions, K, pictures)
    object_guess = guess_object(
        streams.object, points, surface_normals(solid.distance, points), rotations, positions
    )
    hand_guesses = {
        side: guess_hand(
            streams.guess[side], model, motions[side], _seen_fingers(side, model, motions[side], K, pictures)
        )
        for side, model in hand_models.items()
        if side in hands
    }
    colors = solid.albedo(points) * streams.points.normal(0.95, 0.03, (len(points), 1))
    object_track, shift = _object_track(object_guess, np.clip(colors, 0, 1))
    write_hold(
        folder,
        name=name or f"synthetic_{object}_{seed}",
        frame_names=[f"{t:05d}.png" for t in range(frames)],
        images=[(p.image * 255).round().astype(np.uint8) for p in pictures],
        masks=[p.mask for p in pictures],
        K=K,
        normalize_shift=shift,
        hands={side: _hand_track(hand_models[side], guess, shift) for side, guess in hand_guesses.items()},
        object=object_track,
        # torch pickles the tensor's address; without it the files have the same bytes every time.
        torch_norm_mat=False,
    )
    arrays: dict[str, Any] = {"K": K, "wh": np.array([width, height]), "fps": USUAL_FPS}
    arrays |= _object_truth(object_guess, rotations, positions)
    for side in hands:
        arrays |= _hand_truth(
            side, hand_models[side], motions[side], hand_guesses[side], solid, rotations, positions
        )
    write_ground_truth(folder, arrays=arrays, object_mesh=solid.mesh)
    return folder


class _Streams:
    """Random numbers for each thing, so that with one hand the same object moves the same way."""

    def __init__(self, seed: int) -> None:
        children = iter(np.random.SeedSequence(seed).spawn(9))
        self.shape, self.motion, self.picture, self.points, self.object = (
            np.random.default_rng(next(children)) for _ in range(5)
        )
        self.carry = {side: np.random.default_rng(next(children)) for side in SIDES}
        self.guess = {side: np.random.default_rng(next(children)) for side in SIDES}


def _grasp_verts(model: HandLike, betas: np.ndarray, grasp: Grasp) -> np.ndarray:
    return pose_hand(model, betas, grasp.fingers[None], grasp.rotation[None], grasp.wrist[None])[0][0]


def _take_pictures(
    streams: _Streams,
    solid: SolidObject,
    models: Mapping[Side, HandLike],
    motions: Mapping[Side, HandMotion],
    rotations: np.ndarray,
    positions: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
) -> list[Picture]:
    """Cast every frame before a soft background, with sensor noise on top."""
    background = _background(streams.picture, *size)
    skins = {side: _skin(models[side]) for side in motions}
    pictures = []
    for t, (rotation, position) in enumerate(zip(rotations, positions, strict=True)):
        mesh = solid.mesh
        bodies = [
            Body(
                MASK_VALUES["object"],
                mesh.vertices @ rotation.T + position,
                mesh.faces,
                solid.normals @ rotation.T,
                mesh.vertices,
                solid.albedo,
            )
        ]
        for side, motion in motions.items():
            faces = models[side].faces.numpy()
            normals = vertex_normals(motion.verts[t], faces)
            rest = models[side].v_template.double().numpy()
            bodies.append(Body(MASK_VALUES[side], motion.verts[t], faces, normals, rest, skins[side]))
        picture = take_picture(bodies, K, background)
        noisy = picture.image + _SENSOR_NOISE * streams.picture.standard_normal(picture.image.shape)
        pictures.append(replace(picture, image=np.clip(noisy, 0, 1)))
    return pictures


def _skin(model: HandLike) -> PointFunction:
    """The colour of a hand over its rest pose."""
    rest = model.v_template.double().numpy()
    joints = rest_joints(model, np.zeros(10))
    tips = rest[model.tip_vertex_ids.numpy()]
    last = joints[[finger[-1] for finger in FINGERS.values()]]
    return lambda points: skin_tone(points, fingernails(points, tips, last))


def _background(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """A room out of focus: soft blocks of muted colour, [H, W, 3]."""
    blocks = rng.uniform(0.2, 0.75, (7, 9, 1)) + rng.uniform(-0.12, 0.12, (7, 9, 3))
    fine = np.repeat(np.repeat(blocks, -(-height // 7), axis=0), -(-width // 9), axis=1)[:height, :width]
    return np.clip(scipy.ndimage.gaussian_filter(fine, (0.035 * width, 0.035 * width, 0)), 0, 1)


def _project(points: np.ndarray, K: np.ndarray) -> np.ndarray:
    pixels = points @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def _seen(points: np.ndarray, K: np.ndarray, picture: Picture, label: int) -> np.ndarray:
    """Which points [N] (camera frame, on a surface) the camera sees, bool."""
    height, width = picture.mask.shape
    column, row = np.floor(_project(points, K)).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
    return (
        inside
        & (picture.mask[row, column] == label)
        & (points[:, 2] < picture.depth[row, column] + _SEEN_WITHIN)
    )


def _seen_fingers(
    side: Side, model: HandLike, motion: HandMotion, K: np.ndarray, pictures: list[Picture]
) -> np.ndarray:
    """How much of each finger the camera sees over the clip, [5] in [0, 1]."""
    owner = model.lbs_weights.argmax(dim=1).numpy()
    seen = np.mean(
        [_seen(v, K, picture, MASK_VALUES[side]) for v, picture in zip(motion.verts, pictures, strict=True)],
        axis=0,
    )
    # Half of a finger always faces away from the camera.
    return np.array([min(1.0, 2 * seen[np.isin(owner, finger)].mean()) for finger in FINGERS.values()])


def _seen_points(
    rng: np.random.Generator,
    solid: SolidObject,
    rotations: np.ndarray,
    positions: np.ndarray,
    K: np.ndarray,
    pictures: list[Picture],
) -> np.ndarray:
    """Points [N, 3] that structure from motion would find: seen in several frames, denser on print."""
    areas = face_areas(solid.mesh.vertices, solid.mesh.faces)
    faces = rng.choice(len(areas), size=13000, p=areas / areas.sum())
    weights = rng.dirichlet((1, 1, 1), size=len(faces))
    points = np.einsum("nk,nki->ni", weights, solid.mesh.vertices[solid.mesh.faces[faces]])
    times_seen = np.sum(
        [
            _seen(points @ rotation.T + position, K, picture, MASK_VALUES["object"])
            for rotation, position, picture in zip(rotations, positions, pictures, strict=True)
        ],
        axis=0,
    )
    contrast = np.abs(
        solid.albedo(points + 0.0015 * rng.standard_normal(points.shape)) - solid.albedo(points)
    ).sum(1)
    keep = (0.12 + np.minimum(contrast, 0.5)) * np.minimum(times_seen / 8, 1)
    return points[(times_seen >= _SEEN_FRAMES) & (rng.random(len(points)) < keep)]


def _hand_track(model: HandLike, guess: HandGuess, shift: np.ndarray) -> HandTrack:
    """A guess in the camera as a track in HOLD's world, x_world = F x_cam + shift."""
    frames = len(guess.wrists)
    root = rest_joints(model, guess.betas)[0]
    return HandTrack(
        global_orient=Rotation.from_matrix(GL_FROM_CV @ guess.rotations).as_rotvec(),
        hand_pose=guess.fingers - _mean_pose(model),
        transl=guess.wrists @ GL_FROM_CV - root + shift,
        betas=guess.betas,
        valid=np.ones(frames, dtype=bool),
    )


def _object_track(guess: ObjectGuess, colors: np.ndarray) -> tuple[ObjectTrack, np.ndarray]:
    """The object's track, and the shift that puts its middle one metre before HOLD's camera."""
    center = (guess.points.min(axis=0) + guess.points.max(axis=0)) / 2
    radius = float(np.linalg.norm(guess.points - center, axis=1).max())
    in_camera = (
        np.einsum("tij,j->ti", guess.rotations, guess.scale * np.median(guess.points, axis=0)) + guess.transl
    )
    shift = shift_before(np.median(in_camera, axis=0))
    metric_from_canon = np.diag([guess.scale * radius] * 3 + [1.0])
    metric_from_canon[:3, 3] = guess.scale * center
    track = ObjectTrack(
        points=(guess.points - center) / radius,
        colors=colors,
        scale=guess.scale,
        metric_from_canon=metric_from_canon,
        rotations=GL_FROM_CV @ guess.rotations,
        transl=guess.transl @ GL_FROM_CV + shift,
        valid=np.ones(len(guess.transl), dtype=bool),
    )
    return track, shift


def _mean_pose(model: HandLike) -> np.ndarray:
    return model.hands_mean.double().numpy()


def _object_truth(guess: ObjectGuess, rotations: np.ndarray, positions: np.ndarray) -> dict[str, Any]:
    s, R, t = guess.similarity
    return {
        "obj_R": rotations,
        "obj_t": positions,
        "obj_scale": 1.0,
        "obj_init_dropped": guess.dropped,
        "init_scale_error": guess.scale_error,
        "pts_is_outlier": guess.outliers,
        "sfm_s": s,
        "sfm_R": R,
        "sfm_t": t,
    }


def _hand_truth(
    side: Side,
    model: HandLike,
    motion: HandMotion,
    guess: HandGuess,
    solid: SolidObject,
    rotations: np.ndarray,
    positions: np.ndarray,
) -> dict[str, Any]:
    frames = len(motion.wrists)
    in_object = np.einsum("tji,tnj->tni", rotations, motion.verts - positions[:, None])
    distances = solid.distance(in_object.reshape(-1, 3)).reshape(frames, -1)
    owner = model.lbs_weights.argmax(dim=1).numpy()
    tips = [distances[:, owner == finger[-1]].min(axis=1) < CONTACT for finger in FINGERS.values()]
    global_orient = Rotation.from_matrix(motion.rotations).as_rotvec()[:, None]
    pose = np.concatenate([global_orient, motion.fingers - _mean_pose(model)], axis=1)
    truth = {
        "pose": pose.reshape(frames, 48),
        "betas": motion.betas,
        "trans": motion.wrists - rest_joints(model, motion.betas)[0],
        "verts": motion.verts.astype(np.float32),
        "joints": motion.joints,
        "faces": model.faces.numpy().astype(np.int32),
        "contact": distances.min(axis=1) < CONTACT,
        "tip_contact": np.stack(tips, axis=1),
        "min_dist": distances.min(axis=1).astype(np.float32),
        "init_dropped": guess.dropped,
    }
    return {f"{side}_{key}": value for key, value in truth.items()}
