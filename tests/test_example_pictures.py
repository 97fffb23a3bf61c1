"""What the pictures of the examples show: a tube without holes, and a fist."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import torch

from bigs.hand import load_hand_models


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_discs_of_the_knot_leave_no_hole() -> None:
    knot = example("render_gaussians").trefoil(2500)
    # Each has neighbours all around whose discs reach it.
    near = torch.cdist(knot.means, knot.means).topk(6, largest=False).values[:, 1:]
    assert (near[:, -1] / knot.scales[:, 0]).quantile(0.99) < 2.4


def test_a_closed_hand_is_a_fist() -> None:
    right = load_hand_models(None)["right"]
    pose = example("pose_hand").fist(right, torch.tensor([0.0, 1.0]))
    joints = right(torch.zeros(10), pose, torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3)).joints
    # Tips of index, middle, ring and pinky lie in the palm; a claw has them 37 to 50 mm from their knuckles.
    tips, knuckles = joints[:, 17:], joints[:, [1, 4, 10, 7]]
    distance = (tips - knuckles).norm(dim=-1)
    assert (distance[0] > 0.05).all() and (distance[1] < 0.032).all()
