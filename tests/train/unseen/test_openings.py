"""Openings: surface before a hand that shows is no surface, and what goes on from it is a picture of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
import trimesh
from toy_scenes import CENTER, HALF, cube_scene

from bigs.geometry.coverage import MeasuredPoints
from bigs.hand import HandModel
from bigs.models.scene import ObjectSurface, Scene
from bigs.raster.settings import RasterSettings
from bigs.train.loop.step import Evidence
from bigs.train.loop.targets import Targets
from bigs.train.plan.config import OpeningConfig
from bigs.train.unseen.openings import openings, without_openings
from bigs.types import SIDES, Side

FRAMES = 8
# A plate this far before the hands, in the object's frame, and so wide.
BEFORE, WIDTH = -0.12, 0.4


@pytest.fixture
def scene(both_hands: Mapping[Side, HandModel]) -> Scene:
    """The cube between its hands; its surface has a plate before them, too, which is not there."""
    scene = cube_scene(both_hands, frames=FRAMES).requires_grad_(False)
    cube = trimesh.creation.box((2 * HALF,) * 3).subdivide_to_size(0.01)
    side = np.linspace(-WIDTH / 2, WIDTH / 2, 81)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    verts = np.column_stack([x, y, np.full(len(x), BEFORE)])
    corner = (81 * np.arange(80)[:, None] + np.arange(80)).ravel()[:, None]
    faces = np.concatenate([corner + np.array(turn) for turn in ((0, 81, 1), (1, 81, 82))])
    scene.replace_surface(
        ObjectSurface(
            torch.as_tensor(np.concatenate([cube.vertices, verts]), dtype=torch.float32),
            torch.as_tensor(np.concatenate([cube.faces, faces + len(cube.vertices)])),
        )
    )
    return scene


def on_plate(scene: Scene) -> np.ndarray:
    return scene.object_surface.verts[:, 2].numpy() == np.float32(BEFORE)


def behind_plate(scene: Scene, evidence: Evidence) -> np.ndarray:
    """Which vertices of the plate fall on a pixel that shows the right hand."""
    verts = scene.object_surface.verts.numpy() + CENTER
    pixels = np.floor(verts[:, :2] / verts[:, 2:] * 100.0 + [40.0, 30.0]).astype(int).clip(0, [79, 59])
    return on_plate(scene) & (evidence.targets.shares["right"][0].numpy()[pixels[:, 1], pixels[:, 0]] > 0.5)


def evidence(scene: Scene, *, flicker: float) -> Evidence:
    """Masks in which the right hand shows and all else is the object, whose brightness flickers."""
    joints = scene.at(torch.arange(FRAMES)).verts("right").detach()
    hand = np.zeros((FRAMES, 60, 80), dtype=np.float32)
    for t, verts in enumerate(joints.numpy()):
        column, row = np.floor(verts[:, :2] / verts[:, 2:] * 100.0 + [40.0, 30.0]).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < 80) & (row < 60)
        hand[t, row[inside], column[inside]] = 1.0
    hand = torch.nn.functional.max_pool2d(torch.as_tensor(hand), 5, 1, 2)
    noise = torch.rand(FRAMES, 60, 80, 1, generator=torch.Generator().manual_seed(0)) - 0.5
    images = (0.5 + flicker * noise).expand(-1, -1, -1, 3).contiguous()
    shares = {"right": hand, "left": torch.zeros_like(hand), "object": 1.0 - hand}
    targets = Targets(images, shares, torch.zeros_like(hand), scene.K, 80, 60)
    return Evidence(targets, {}, {}, {}, {}, "surface", RasterSettings())


def cube_points(scene: Scene, *frames: int) -> MeasuredPoints:
    """Measured points: every vertex of the cube, seen in `frames`."""
    points = scene.object_surface.verts.numpy()[~on_plate(scene)].astype(np.float64)
    sightings = [(t, i) for t in frames for i in range(len(points))]
    return MeasuredPoints(points, np.array(sightings, dtype=int).reshape(-1, 2))


def test_surface_before_a_hand_that_shows_is_open_and_no_other(scene: Scene) -> None:
    clip = evidence(scene, flicker=0.0)
    found = openings(scene, scene.object_surface, clip, cube_points(scene), OpeningConfig())
    before_hand = behind_plate(scene, clip)
    assert before_hand.sum() > 100
    # The outline counts for less than the middle, and steady surface beside the hand stays.
    assert found.sum() > 0.3 * before_hand.sum() and not found[~before_hand].any()
    left = without_openings(scene.object_surface, found)
    assert len(left.verts) <= len(found) - found.sum() and int(left.faces.max()) == len(left.verts) - 1
    kept = {tuple(vert) for vert in scene.object_surface.verts[torch.as_tensor(~found)].tolist()}
    assert {tuple(vert) for vert in left.verts.tolist()} <= kept


def test_it_goes_on_where_brightness_varies_but_not_over_measured_points(scene: Scene) -> None:
    clip = evidence(scene, flicker=0.8)
    # The cube, which the plate hides, tells nothing of usual brightness; a measured strip of the plate does.
    verts = scene.object_surface.verts.numpy().astype(np.float64)
    strip = verts[on_plate(scene) & (verts[:, 0] < -0.1)]
    still = verts[:, 0] < -0.1
    clip.targets.images[:, :, :22] = 0.5
    measured = cube_points(scene)
    measured = measured._replace(points=np.concatenate([measured.points, strip]))
    found = openings(scene, scene.object_surface, clip, measured, OpeningConfig())
    in_view = (np.abs(verts[:, 0]) < 0.1) & (np.abs(verts[:, 1]) < 0.08)
    beside = on_plate(scene) & in_view & ~behind_plate(scene, clip)
    assert found[beside].mean() > 0.8
    assert not found[still].any() and not found[~on_plate(scene)].any()


def test_it_does_not_go_on_where_brightness_varies_as_on_some_measured_surface(scene: Scene) -> None:
    """A one-colour pitcher lost its sides: half of its few measured points vary less than those do."""
    clip, wild = evidence(scene, flicker=0.4), evidence(scene, flicker=0.8)
    verts = scene.object_surface.verts.numpy().astype(np.float64)
    strip = verts[on_plate(scene) & (verts[:, 0] < -0.1)]
    # Most of the measured strip is steady; a quarter of what is in view of it varies more than anything else.
    clip.targets.images[:, :, :22] = wild.targets.images[:, :, :22]
    clip.targets.images[:, :, :10] = 0.5
    measured = cube_points(scene)
    measured = measured._replace(points=np.concatenate([measured.points, strip]))
    found = openings(scene, scene.object_surface, clip, measured, OpeningConfig())
    before_hand = behind_plate(scene, clip)
    assert found[before_hand].any() and not found[~before_hand].any()


@pytest.mark.parametrize("change", ["frames", "share", "area", "depth", "measured"])
def test_each_setting_decides(scene: Scene, change: str) -> None:
    clip = evidence(scene, flicker=0.0)
    strict = {"frames": FRAMES + 1, "share": 1.1, "area": 1.0, "depth": 0.3, "measured": 1.0}
    assert openings(scene, scene.object_surface, clip, cube_points(scene), OpeningConfig()).any()
    assert not openings(
        scene, scene.object_surface, clip, cube_points(scene), OpeningConfig(**{change: strict[change]})
    ).any()


def test_a_hand_that_the_masks_do_not_show_proves_nothing(scene: Scene) -> None:
    clip = evidence(scene, flicker=0.8)
    clip.targets.shares["right"].zero_()
    assert not openings(scene, scene.object_surface, clip, cube_points(scene), OpeningConfig()).any()


def hold(scene: Scene, side: Side, frames: int = FRAMES) -> None:
    """A hand holds the object in the first frames."""
    poses = scene.at(torch.arange(FRAMES))
    held = torch.where(torch.arange(FRAMES) < frames, 0, -1)
    scene.grasps[side].set(held, 0.0, poses.hand(side), poses.object)


def plate_through_hand(scene: Scene, side: Side) -> np.ndarray:
    """Add a plate to the surface that cuts a hand; returns how deep in it each vertex [V] lies."""
    hand = scene.at(torch.arange(1)).verts(side)[0].detach().double().numpy() - CENTER
    low, high = hand.min(0) - 0.03, hand.max(0) + 0.03
    x, z = (a.ravel() for a in np.meshgrid(*(np.linspace(low[i], high[i], 61) for i in (0, 2))))
    plate = np.column_stack([x, np.full(len(x), hand[:, 1].mean()), z])
    corner = (61 * np.arange(60)[:, None] + np.arange(60)).ravel()[:, None]
    faces = np.concatenate([corner + np.array(turn) for turn in ((0, 61, 1), (1, 61, 62))])
    old = scene.object_surface
    verts = np.concatenate([old.verts.numpy(), plate])
    scene.replace_surface(
        ObjectSurface(
            torch.as_tensor(verts, dtype=torch.float32),
            torch.cat([old.faces, torch.as_tensor(faces + len(old.verts))]),
        )
    )
    mesh = trimesh.Trimesh(hand, scene.hand_model("right").faces.numpy(), process=False)
    trimesh.repair.fill_holes(mesh)
    deep = np.full(len(verts), -1.0)
    away = trimesh.proximity.closest_point(mesh, plate)[1]
    deep[len(old.verts) :] = np.where(np.abs(winding(mesh.triangles, plate)) > 0.5, away, -away)
    return deep


def winding(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How often closed triangles [F, 3, 3] wind around points [N]: their solid angles by 4 pi (Van Oosterom
    and Strackee 1983)."""
    total = np.zeros(len(points))
    for triangle in triangles:
        a, b, c = (corner - points for corner in triangle)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        dots = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        total += 2.0 * np.arctan2((a * np.cross(b, c)).sum(1), dots)
    return total / (4.0 * np.pi)


@pytest.mark.parametrize("side", SIDES)
def test_no_surface_lies_in_a_hand_that_holds_the_object(scene: Scene, side: Side) -> None:
    clip, measured = evidence(scene, flicker=0.0), cube_points(scene)
    shown = evidence(scene, flicker=0.0)
    deep = plate_through_hand(scene, side)
    clip.targets.shares["right"].zero_()  # nothing is seen through the surface
    assert not openings(scene, scene.object_surface, clip, measured, OpeningConfig()).any(), "not held"
    hold(scene, side)
    found = openings(scene, scene.object_surface, clip, measured, OpeningConfig())
    assert (deep > 0.005).sum() > 50 and found[deep > 0.005].mean() > 0.95
    assert not found[deep < 0.001].any()
    # Not where a point was measured, nor for too small a part, a shallow one or a short grasp.
    beside = measured._replace(points=np.concatenate([measured.points, scene.object_surface.verts[found]]))
    assert not openings(scene, scene.object_surface, clip, beside, OpeningConfig()).any()
    for strict in ({"area": 1.0}, {"inside": 0.1}, {"frames": FRAMES + 1}):
        assert not openings(scene, scene.object_surface, clip, measured, OpeningConfig(**strict)).any()
    seen = openings(scene, scene.object_surface, shown, measured, OpeningConfig())
    assert seen[found].all() and seen[on_plate(scene)].any(), "beside what is seen through"
    hold(scene, side, OpeningConfig().frames - 1)
    assert not openings(scene, scene.object_surface, clip, measured, OpeningConfig()).any()


def test_surface_before_points_that_were_measured_through_it_is_open(scene: Scene) -> None:
    clip = evidence(scene, flicker=0.0)
    clip.targets.shares["right"].zero_()
    plan = OpeningConfig()
    sights = [cube_points(scene, *range(frames)) for frames in (plan.frames - 1, plan.frames)]
    few, enough = (openings(scene, scene.object_surface, clip, measured, plan) for measured in sights)
    assert not few.any()
    # What the cube would show through, and nothing beside it.
    verts = scene.object_surface.verts.numpy()
    before = on_plate(scene) & (np.abs(verts[:, :2]) < HALF).all(1)
    assert enough[before & (np.abs(verts[:, :2]) < 0.6 * HALF).all(1)].all()
    assert not enough[~on_plate(scene)].any() and not enough[(np.abs(verts[:, :2]) > 1.5 * HALF).any(1)].any()
    strict = OpeningConfig(points_share=1.1)
    assert not openings(scene, scene.object_surface, clip, sights[1], strict).any()
