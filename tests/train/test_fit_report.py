"""What a report says was left out: each with its seconds, and nothing that was not."""

from __future__ import annotations

from bigs.train.fit_report import FROZEN, OUTSIDE, SETTLED, FitReport


def test_what_was_left_out_has_its_seconds() -> None:
    report = FitReport()
    for seconds in (1.0, 0.5):
        report.spare(SETTLED, seconds)
    report.spare(FROZEN, 0.0)
    report.spare(OUTSIDE, 2.0)
    assert report.left_out(0.25) == f"{SETTLED} (1.5 s), 25% {OUTSIDE} (2 s)"
    # Pictures that are looked at as a whole leave nothing out.
    assert report.left_out(0.0) == f"{SETTLED} (1.5 s)"
    assert FitReport().left_out(0.25) == ""
