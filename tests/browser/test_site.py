"""The documentation site in a browser, opened from its folder: it is whole, search works, axe-core finds no barrier."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser_pages import NARROW, WIDE, WatchedPage

KINDS_OF_PAGES = (
    "index",
    "tutorials/simulate_and_look",
    "notebooks/own_effect",
    "howto/raw_scan",
    "explanation/how_gap_works",
    "reference/configuration",
    "reference/effects/tls.wobble",
    "reference/api/scene.ray_casting",
    "validation/gap_rendered_photographs",
    "reference/api/sensors.models",
    "validation/gap_closed_form",
)
"""One page of each kind for `make test`, and long ones of two kinds for `make validate`."""
WITHOUT_PICTURE = "[...document.images].filter(image => image.complete && image.naturalWidth < 2).map(image => image.src)"


@pytest.mark.parametrize("name", KINDS_OF_PAGES)
def test_a_page_of_the_site(name: str, site: Path, page: WatchedPage) -> None:
    opened = page.open((site / f"{name}.html").as_uri())
    for width in (WIDE, NARROW):
        opened.set_viewport_size({"width": width, "height": 900})
        page.wait_for(lambda: page.overflow_px() <= 0)
        assert opened.evaluate(WITHOUT_PICTURE) == []
        assert page.barriers() == []


def test_the_site_by_keyboard(site: Path, page: WatchedPage) -> None:
    """The first stop leads to the text; a search by keyboard leads to the page that was looked for."""
    opened = page.open((site / "index.html").as_uri())
    opened.keyboard.press("Tab")
    assert "md-skip" in opened.evaluate("document.activeElement.className")
    opened.keyboard.press("/")
    opened.keyboard.type("wobble")
    opened.locator(".md-search-result__link mark", has_text="wobble").first.wait_for()
    opened.keyboard.press("ArrowDown")
    opened.keyboard.press("Enter")
    opened.wait_for_url(lambda address: "index.html" not in address)
    assert "wobble" in opened.inner_text("article").lower()
