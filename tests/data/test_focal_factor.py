"""Another focal length changes depths and K, and no picture."""

from __future__ import annotations

import numpy as np
import torch

from bigs.data.base import Clip
from bigs.data.focal import with_focal_factor
from bigs.hand import HandModel
from bigs.types import Side


def anchors(clip: Clip, wrists: dict[Side, np.ndarray]) -> np.ndarray:
    """Both wrists and the object's middle in the camera, [3, T, 3]."""
    assert clip.object is not None
    obj = clip.object.rotations @ clip.object.middle() + clip.object.transl
    world = np.stack([*(wrists[side] + track.transl for side, track in clip.hands.items()), obj])
    cam = clip.cam_from_world
    return np.einsum("tij,ntj->nti", cam[:, :3, :3], world) + cam[:, :3, 3]


def test_subjects_stay_where_they_are_seen(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    wrists = {side: both_hands[side].rest_wrist(track.betas) for side, track in tiny.hands.items()}
    longer = with_focal_factor(tiny, wrists, 1.25)
    before, after = anchors(tiny, wrists), anchors(longer, wrists)
    np.testing.assert_allclose(after[..., 2], 1.25 * before[..., 2])
    seen = [cam @ clip.K.T / cam[..., 2:] for clip, cam in ((tiny, before), (longer, after))]
    np.testing.assert_allclose(seen[1], seen[0])
    assert not np.allclose(longer.K, tiny.K) and longer.K[0, 2] == tiny.K[0, 2]
    back = with_focal_factor(longer, wrists, 0.8)
    np.testing.assert_allclose(anchors(back, wrists), before)
    np.testing.assert_allclose(back.K, tiny.K)


def test_the_rest_wrist_is_where_the_model_poses_it(both_hands: dict[Side, HandModel]) -> None:
    betas = np.linspace(-1.0, 1.0, 10)
    for model in both_hands.values():
        joints = model.rest_joints(torch.as_tensor(betas, dtype=torch.float32))
        np.testing.assert_allclose(model.rest_wrist(betas), joints[0].numpy(), atol=1e-6)
