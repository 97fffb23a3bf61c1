"""Targets are kept while there is room, and made ahead without anything changing but the time."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.train.loop.target_source import TargetSource
from bigs.train.loop.targets import crop_box


def source_of(clip: Clip) -> TargetSource:
    return TargetSource(clip, np.zeros((len(clip), clip.height, clip.width), dtype=bool))


def test_targets_are_kept_while_there_is_room(tiny: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    source = source_of(tiny)
    first, second = source.at(40), source.at(20)
    assert source.at(40) is first
    assert source.at(20) is second
    # Room for the smaller ones alone: the larger go when they are not looked at.
    monkeypatch.setattr("bigs.train.loop.target_source._KEPT", second.size())
    source.at(30)
    assert source.at(20) is second
    assert source.at(40) is not first


def test_the_share_of_a_frame_that_is_looked_at(tiny: Clip) -> None:
    x0, y0, x1, y1 = crop_box(tiny)
    assert source_of(tiny).cropped() == (x1 - x0) * (y1 - y0) / (tiny.width * tiny.height)
    assert 0.1 < source_of(tiny).cropped() < 1.0


def test_nothing_is_enlarged_or_made_twice(tiny: Clip) -> None:
    source = source_of(tiny)
    whole = source.at(0)
    assert source.at(tiny.width) is whole
    assert source.at(10 * tiny.width) is whole


@pytest.mark.parametrize("threads", [1, 2])
def test_the_next_are_made_ahead(
    tiny: Clip, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest, threads: int
) -> None:
    request.addfinalizer(partial(torch.set_num_threads, torch.get_num_threads()))
    torch.set_num_threads(threads)
    source, plain = source_of(tiny), source_of(tiny)
    source.at(40)
    # What is there already is passed over; it takes one thread, whatever torch has.
    source.make_ahead([40, 20, 30])
    expected = plain.at(20)
    monkeypatch.setattr(TargetSource, "_load", None)
    found = source.at(20)
    assert found.images.equal(expected.images) and found.unknown.equal(expected.unknown)
    assert all(found.shares[entity].equal(expected.shares[entity]) for entity in expected.shares)
    assert found.K.equal(expected.K)


def test_what_was_made_ahead_stays_until_it_is_asked_for(tiny: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    source = source_of(tiny)
    source.make_ahead([20])
    source.at(40)
    monkeypatch.setattr(TargetSource, "_load", None)
    assert max(source.at(20).width, source.at(20).height) <= 20


def test_a_picture_that_cannot_be_read_is_told_when_it_is_asked_for(tiny: Clip, tmp_path: Path) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    source = source_of(replace(tiny, image_paths=(*tiny.image_paths[:-1], broken)))
    source.make_ahead([20])
    with pytest.raises(InputError, match=r"broken\.png: expected a readable image"):
        source.at(20)
