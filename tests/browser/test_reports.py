"""Every report in a browser: it is whole, nothing is missing, it suits a phone, and a keyboard and axe-core find no barrier."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser_pages import NARROW, WIDE, WatchedPage

REPORTS = (
    "simulate_tls",
    "simulate_stereo",
    "compare",
    "inspect",
    "icp-study",
    "calibrate",
    "gap",
    "identifiability",
    "monitor",
)
WITHOUT_PICTURE = "[...document.images].filter(image => !image.complete || image.naturalWidth < 50).map(image => image.alt)"
FOCUS = "(element => [element.tagName, element.className, getComputedStyle(element).outlineStyle])(document.activeElement)"


@pytest.mark.parametrize("name", REPORTS)
def test_a_report(name: str, outputs: Path, page: WatchedPage) -> None:
    opened = page.open((outputs / name / "report.html").as_uri())
    assert opened.locator("h1").count() == 1
    assert opened.locator("img").count() > 0
    for width in (WIDE, NARROW):
        opened.set_viewport_size({"width": width, "height": 900})
        page.wait_for(lambda: page.overflow_px() <= 0)
        assert opened.evaluate(WITHOUT_PICTURE) == []
        assert page.barriers() == []


@pytest.mark.parametrize("name", REPORTS)
def test_a_report_by_keyboard(name: str, outputs: Path, page: WatchedPage) -> None:
    """Tab reaches every table, link and part that folds, visibly, and Enter unfolds."""
    opened = page.open((outputs / name / "report.html").as_uri(), NARROW)
    stops = opened.locator(".wide:visible, summary:visible, a:visible").count()
    for _ in range(stops):
        opened.keyboard.press("Tab")
        tag, kind, outline = opened.evaluate(FOCUS)
        assert tag in ("SUMMARY", "A") or kind == "wide"
        assert outline != "none"
        if tag == "SUMMARY":
            folded = opened.evaluate("document.activeElement.parentElement.open")
            for expected in (not folded, folded):
                opened.keyboard.press("Enter")
                assert opened.evaluate("document.activeElement.parentElement.open") == expected
