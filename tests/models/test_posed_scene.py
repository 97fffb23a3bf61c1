"""Poses worked out once for a whole clip are those of its frames on their own, gradients included."""

from __future__ import annotations

from collections import Counter

import pytest
import torch
from small_scene import FRAMES, make_scene

from bigs.hand import HandModel
from bigs.models.poses import HandPoses, ObjectPoses
from bigs.models.scene import Scene

ALL, SOME = torch.arange(FRAMES), torch.tensor([0, FRAMES - 1])


@pytest.fixture
def scene() -> Scene:
    """With correctives and light; the left hand holds the object in all frames but the last."""
    scene = make_scene(rich=True)
    of_frame = torch.zeros(FRAMES, dtype=torch.long)
    of_frame[-1] = -1
    with torch.no_grad():
        posed = scene.at(ALL)
        scene.grasps["left"].set(of_frame, 0.1, posed.hand("left"), posed.object)
    return scene


def looked_at(scene: Scene, posed) -> torch.Tensor:
    """Something that depends on all that can be asked of two frames' posed."""
    canonical = scene.canonical(scene.entities)
    total = torch.zeros(())
    for entity in scene.entities:
        part = posed.posed({entity: canonical[entity]})
        total = total + part.means.sin().sum() + part.quats.sin().sum() + part.colors.sin().sum()
        if entity != "object":
            total = total + posed.verts(entity).cos().sum() + posed.joints(entity).cos().sum()
            total = total + posed.in_object_frame(posed.joints(entity)).sin().sum()
    return total + posed.object_points(torch.eye(3)).sin().sum()


def test_frames_of_a_whole_clip_are_those_frames(scene: Scene) -> None:
    direct, shared = looked_at(scene, scene.at(SOME)), looked_at(scene, scene.at(ALL).at(SOME))
    torch.testing.assert_close(direct, shared)
    parameters = [p for p in scene.parameters() if p.requires_grad]
    expected = torch.autograd.grad(direct, parameters, allow_unused=True)
    found = torch.autograd.grad(shared, parameters, allow_unused=True)
    assert sum(gradient is not None for gradient in found) > 10
    for a, b in zip(expected, found, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            torch.testing.assert_close(a, b, atol=2e-4, rtol=2e-4)


def test_joints_are_the_models_joints(scene: Scene) -> None:
    posed = scene.at(ALL)
    for side in scene.sides:
        pose, model = posed.canonical_hand(side), scene.hand_model(side)
        out = model(scene.hand_betas(side), pose.hand_pose, pose.global_orient, pose.wrist)
        mirror = torch.tensor([-1.0 if side == "left" else 1.0, 1.0, 1.0])
        torch.testing.assert_close(posed.joints(side), mirror * out.joints)
        torch.testing.assert_close(posed.verts(side), mirror * out.vertices)


def test_nothing_is_worked_out_twice(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: Counter[str] = Counter()
    for owner, name in ((HandPoses, "forward"), (ObjectPoses, "forward"), (HandModel, "skeleton")):
        monkeypatch.setattr(owner, name, counting(calls, owner.__name__, getattr(owner, name)))
    clip = scene.at(ALL)
    for posed in (clip.at(SOME), clip.at(ALL[:1]), clip):
        looked_at(scene, posed)
    assert calls == {"HandPoses": 2, "ObjectPoses": 1, "HandModel": 2}


def counting(calls: Counter[str], name: str, function):
    def counted(*arguments, **options):
        calls[name] += 1
        return function(*arguments, **options)

    return counted
