"""Whether masks touch, against the distance of every pixel of the one from every pixel of the other."""

from __future__ import annotations

import numpy as np

from bigs.data.touching import masks_touch
from bigs.types import MASK_VALUES


def test_masks_touch_where_pixels_are_within_reach() -> None:
    rng = np.random.default_rng(0)
    answers = []
    for _ in range(300):
        labels = np.zeros((14, 20), dtype=np.uint8)
        for entity in ("right", "object"):
            y, x = rng.integers(0, 12), rng.integers(0, 18)
            shape = rng.random((3, 3)) < 0.4
            labels[y : y + 3, x : x + 3][shape[: 14 - y, : 20 - x]] = MASK_VALUES[entity]
        hand, item = (np.argwhere(labels == MASK_VALUES[entity]) for entity in ("right", "object"))
        apart = np.abs(hand[:, None] - item[None]).max(-1)
        reach = int(rng.integers(1, 5))
        expected = apart.size > 0 and apart.min() <= reach
        assert masks_touch(labels, "right", reach) == expected
        assert not masks_touch(labels, "left", reach)
        answers.append(expected)
    assert 50 < sum(answers) < 250
