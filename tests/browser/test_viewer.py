"""The viewer in a browser: each kind of folder is drawn, and its controls work by mouse and by keyboard."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from browser_pages import NARROW, WIDE, WatchedPage

from pipeline.view.server import make_page_server, open_results, open_second

TOKEN = "a-token_of-24-bytes"
KINDS = {
    "gap": ("gap",),
    "data set": ("dataset/test",),
    "monitor": ("monitor",),
}
"""Folders of which each kind is opened alone; a run and a pair of runs are opened to use their controls."""


@contextmanager
def served(folder: Path, second: Path | None = None) -> Iterator[str]:
    """Serve a folder; yield its address."""
    results = open_results(folder)
    server = make_page_server(results, 0, TOKEN, open_second(second, results) if second else None)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/?token={TOKEN}"
    server.shutdown()
    thread.join()


def drawn(page: WatchedPage, address: str, widths: tuple[int, ...]) -> Any:
    """Open the viewer, and wait until wall and map are drawn; look for barriers, and for what is too wide at each width, px."""
    opened = page.open(address, widths[0])
    opened.wait_for_selector("#map .heatmaplayer image")
    opened.wait_for_selector("#wall canvas")
    opened.wait_for_load_state("networkidle")
    for width in widths:
        opened.set_viewport_size({"width": width, "height": 900})
        page.wait_for(lambda: page.overflow_px() <= 0)
        assert width != WIDE or page.barriers() == []
    return opened


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_in_the_viewer(kind: str, outputs: Path, page: WatchedPage) -> None:
    with served(*(outputs / name for name in KINDS[kind])) as address:
        opened = drawn(page, address, (WIDE, NARROW))
        if kind != "gap":  # no scene change is in it
            opened.click("#next")
            opened.wait_for_selector("#facts table")
        page.close()


def test_the_controls_by_mouse(outputs: Path, page: WatchedPage) -> None:
    with served(outputs / "simulate_tls") as address:
        opened = drawn(page, address, (NARROW, WIDE))
        assert "Share chart" not in opened.content()  # Plotly's own button would upload the chart
        opened.click("#next")
        page.says("#facts h2", "block 1")
        page.settle()
        opened.click("#previous")
        page.says("#facts h2", "block 3")
        page.settle()
        opened.click("#whole")
        opened.click("#shown label:has-text('points')")
        page.says("#note", "points are shown")
        page.settle()
        opened.click("#step")
        opened.click("[role=listbox] >> text=epoch 2")
        page.says("#step-value", "epoch 2")
        page.settle()
        opened.click("#play")
        page.says("#step-value", "epoch 1")
        opened.click("#play")
        page.says("#play", "play")
        page.close()


def test_the_controls_by_keyboard(outputs: Path, page: WatchedPage) -> None:
    """Every control is reached with Tab alone, in the order of the page, and works with arrows, space and Enter.

    The folder is a pair of runs.
    """
    with served(outputs / "simulate_tls", outputs / "simulate_stereo") as address:
        opened = drawn(page, address, (NARROW, WIDE))
        assert "simulate_stereo" in opened.locator("#note").inner_text()
        opened.keyboard.press("Tab")
        assert opened.evaluate("document.activeElement.id") == "step"
        for key, chosen in (("Enter", "1"), ("ArrowDown", "2")):
            opened.keyboard.press(key)
            page.wait_for(lambda value=chosen: opened.evaluate("document.activeElement.value") == value)
        opened.keyboard.press("Space")
        page.says("#step-value", "epoch 2")
        page.settle()
        seen = []
        while "next" not in seen and len(seen) < 30:
            opened.keyboard.press("Tab")
            name = opened.evaluate("document.activeElement.id || document.activeElement.value || document.activeElement.role")
            seen.append(name)
            if name == "points":
                opened.keyboard.press("Space")
            if name == "slider":
                opened.keyboard.press("ArrowRight")
        page.says("#note", "points are shown")
        assert opened.evaluate("document.querySelector('#border [role=slider]').ariaValueNow") == "51"
        page.settle()
        opened.keyboard.press("Enter")
        page.says("#facts h2", "block 1")
        page.close()
