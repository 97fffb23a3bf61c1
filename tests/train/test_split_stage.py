"""The stage that frees every Gaussian: it splits those of the object that pictures show."""

from __future__ import annotations

from dataclasses import replace

import torch

from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.train.fit import fit
from bigs.train.plan.config import PriorConfig, SplitStage
from bigs.train.plan.presets import SMOKE
from bigs.types import Side


def test_what_pictures_hardly_show_stays_whole(tiny: Clip, both_hands: dict[Side, HandModel]) -> None:
    """Its parts would keep the gaps between them, since hardly anything moves or widens them."""
    plan = replace(SMOKE, prior=PriorConfig("off"))
    one, four = (
        fit(tiny, both_hands, replace(plan, stages=(SplitStage(parts=parts, overlap=1.2),)))[0].object_splats
        for parts in (1, 2)
    )
    shown = one.freedom >= 0.5
    assert 0 < shown.sum() < len(shown)
    each = torch.where(shown, 4, 1)
    assert torch.equal(four.freedom, one.freedom.repeat_interleave(each))
    parent = shown.repeat_interleave(each)
    assert torch.equal(four.base_points[~parent], one.base_points[~shown])
    sizes = one.base_log_scales.repeat_interleave(each, dim=0).exp()
    width = torch.where(parent, 1.2 / 2, 1.0)[:, None]
    torch.testing.assert_close(four.base_log_scales.exp()[:, :2], sizes[:, :2] * width)
