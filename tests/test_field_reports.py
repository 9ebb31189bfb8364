"""Kinds of files that broke other programs: each is read as it is meant, or refused with the reason."""

from __future__ import annotations

import pytest

from benchmarks.field_reports.report import Report
from benchmarks.field_reports.run import KINDS, PAGE, outcome

REPORTS = [report for reports in KINDS.values() for report in reports]


@pytest.mark.parametrize("report", REPORTS, ids=lambda report: report.thread)
def test_the_page_says_what_happens(report: Report) -> None:
    """`outcome` itself fails if a file is read wrongly, or accepted although it should not be."""
    (row,) = (line for line in PAGE.read_text(encoding="utf-8").splitlines() if f"[{report.thread}](" in line)
    assert outcome(report).replace("|", "/") in row


def test_there_are_enough_reports_and_each_stands_once() -> None:
    threads = [report.thread for report in REPORTS]
    assert len(set(threads)) == len(threads) >= 25
