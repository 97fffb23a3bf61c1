"""The scores that are shown first: five, each explained, for one hand as for two."""

from __future__ import annotations

from bigs.metrics.headlines import HEADLINES, headline_keys, headline_meanings, headline_table
from bigs.metrics.picture import ALL_METRICS

TWO_HANDS = {key: 1.0 for key in ALL_METRICS}
ONE_HAND = {key: 1.0 for key in ALL_METRICS if not key.endswith(("_h", "_l", "_h_sq", "_l_sq"))}


def test_five_scores_with_a_line_each() -> None:
    for scores, hand in ((TWO_HANDS, "mpjpe_ra_h"), (ONE_HAND, "mpjpe_ra_r")):
        rows = {"initial": scores, "result": scores}
        assert len(headline_table(rows)) == 1 + 5
        assert headline_keys(rows)[0] == hand
        lines = headline_meanings(rows)
        assert len(lines) == 5
        assert all(line.endswith(("lower is better", "higher is better")) for line in lines)


def test_the_direction_is_the_metrics_own() -> None:
    for headline in HEADLINES:
        for key in headline.keys:
            assert headline.means.endswith(f"{ALL_METRICS[key].better} is better")


def test_a_score_that_is_missing_for_a_reason_stays() -> None:
    rows = {"result": {"psnr_foreground": 20.0}}
    assert headline_keys(rows, {"f10_icp": "no object"}) == ["f10_icp", "psnr_foreground"]
    assert any("no object" in row[0] for row in headline_table(rows, {"f10_icp": "no object"}))
