"""A page in Chromium that remembers every complaint, and small outputs of the commands that make something to look at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gap_cases import write_scan
from monitor_cases import STATION, las, points
from tiny_dataset import COMMAND, TINY, tiny

from pipeline.cli.main import main
from pipeline.dataset.run import make_dataset

WIDE, NARROW = 1400, 420
"""Widths of a desktop's window and of a phone, px."""
SEVERE = ("serious", "critical")
_RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21aa", "best-practice"], "preload": False, "resultTypes": ["violations"]}
_SITE = """\
seed: 3
epochs: 2
wall: {style: glendale, width_m: 6.0, height_m: 4.0, resolution_m: 0.1, seed: 1}
rockfall: {count: 3, size_m: {kind: gaussian, mean: 0.5, sigma: 0.05, minimum: 0.3}}
station: {distance_m: 20.0}
scanner: {azimuth_step_rad: 0.003, zenith_step_rad: 0.003}
cameras: {distance_m: 20.0, base_m: 5.0, width: 368, height: 246}
depth_map: high
difference: {gsd_m: 0.05}
icp: {max_iteration: 5}
planning: {gsd_m: 0.4, block_size_m: [0.2]}
calibration: {windows: 6, window_px: 16, simulations: 60}
"""


class WatchedPage:
    """A page of Chromium, with what its console, network and scripts complained of in `complaints`.

    `tally` counts what was done with the page and what came of it, for docs/validation/browser.md. `page` is Playwright's page,
    which several of these use in turn.
    """

    def __init__(self, page: Any) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.tally: Counter[str] = Counter()
        self.axe = ""
        self._count_actions()
        self._awaited = 0
        self._listeners: tuple[tuple[str, Callable[[Any], Any]], ...] = (
            ("request", lambda _: self._ask()),
            ("requestfinished", lambda _: self._receive()),
            ("requestfailed", lambda _: self._receive()),
            ("console", lambda said: said.type == "error" and self._complain("console errors", said.text)),
            ("pageerror", lambda error: self._complain("console errors", str(error))),
            ("requestfailed", lambda asked: self._complain("missing files", f"{asked.url}: {asked.failure}")),
            (
                "response",
                lambda answer: answer.status >= 400 and self._complain("missing files", f"{answer.url}: {answer.status}"),
            ),
        )
        for event, listener in self._listeners:
            self.page.on(event, listener)

    def _ask(self) -> None:
        self._awaited += 1
        self._count("files")

    def _receive(self) -> None:
        self._awaited -= 1

    def _count(self, what: str, number: int = 1) -> None:
        self.tally[what] += number

    def _complain(self, kind: str, text: str) -> None:
        self._count(kind)
        self.complaints.append(text)

    def _count_actions(self) -> None:
        """Let clicks and pressed keys be counted."""
        click, press = self.page.click, self.page.keyboard.press

        def counted_click(*words: Any, **options: Any) -> None:
            self._count("clicks")
            click(*words, **options)

        def counted_press(*words: Any, **options: Any) -> None:
            self._count("keys")
            press(*words, **options)

        self.page.click, self.page.keyboard.press = counted_click, counted_press

    def open(self, address: str, width: int = WIDE) -> Any:
        """Open an address in a window of a width, px; return Playwright's page."""
        self.page.set_viewport_size({"width": width, "height": 900})
        self.page.goto(address)
        return self.page

    def barriers(self) -> list[str]:
        """Return the serious barriers that axe-core finds for people who see little or use no mouse."""
        from axe_playwright_python.sync_playwright import Axe

        response = Axe().run(self.page, options=_RULES).response
        found = response["violations"]
        self.axe = response["testEngine"]["version"]
        self._count("axe runs")
        for rule in ("color-contrast", "image-alt"):
            self._count(f"{rule} runs", any(each["id"] == rule for kind in ("passes", "violations") for each in response[kind]))
        self._count("severe violations", sum(each["impact"] in SEVERE for each in found))
        self._count("lesser violations", sum(each["impact"] not in SEVERE for each in found))
        return [f"{each['id']}: {each['nodes'][0]['html'][:200]}" for each in found if each["impact"] in SEVERE]

    def overflow_px(self) -> int:
        """Return by how much the page is wider than its window, px."""
        return int(self.page.evaluate("document.documentElement.scrollWidth - window.innerWidth"))

    def wait_for(self, condition: Callable[[], bool], times: int = 1) -> None:
        """Wait at most thirty seconds until a condition holds, as often in a row as is said, a tenth of a second apart."""
        held = 0
        for _ in range(300):
            held = held + 1 if condition() else 0
            if held == times:
                return
            self.page.wait_for_timeout(100)
        raise AssertionError("the condition did not come true within thirty seconds")

    def says(self, selector: str, text: str) -> None:
        """Wait until an element contains a text."""
        found = self.page.locator(selector)
        try:
            self.page.locator(selector, has_text=text).wait_for()
        except Exception as error:
            focus = self.page.evaluate("document.activeElement.outerHTML.slice(0, 200)")
            state = f"{selector} says {found.all_inner_texts()}, the focus is on {focus}, {self._awaited} answers are awaited"
            raise AssertionError(f"{selector} does not say '{text}': {state}") from error

    def settle(self) -> None:
        """Wait until the page has had all answers that it asked the server for, half a second long."""
        self.wait_for(lambda: self._awaited == 0, times=5)

    def close(self) -> None:
        """Leave what the page shows and listen no more; closing it again does nothing."""
        for event, listener in self._listeners:
            self.page.remove_listener(event, listener)
        if self._listeners:
            del self.page.click, self.page.keyboard.press  # those of Playwright again, which count nothing
            self.page.goto("about:blank")
        self._listeners = ()


def make_outputs(folder: Path) -> None:
    """Fill a folder with the outputs of small commands, each in a folder of its own."""
    folder.mkdir()
    site = folder / "site.yaml"
    site.write_text(_SITE)
    scan = folder / "scan"
    scan.mkdir()
    write_scan(scan, 1, step_rad=0.012, ranges=lambda seen: seen.R + 0.02)
    before = las(folder / "2026-03-01.las", points(60_000, 1))
    after = las(folder / "2026-04-01.las", points(60_000, 2, ((5.0, 5.0, 1.0, 0.3),)))
    commands: dict[str, list[Any]] = {
        "simulate_tls": ["simulate", "--sensor", "tls", "--config", site],
        "simulate_stereo": ["simulate", "--sensor", "stereo", "--config", site, "--set", "epochs=1"],
        "compare": ["compare", site, "--epochs", "2", "--sizes-m", "0.3", "0.6"],
        "inspect": ["inspect", site],
        "icp-study": ["icp-study", folder / "simulate_tls"],
        "calibrate": ["calibrate", folder / "simulate_tls", "--no-greedy", "--set", "icp=null"],  # registers no simulated map
        "gap": ["gap", scan],
        "identifiability": ["gap", "--identifiability", scan],
        "monitor": ["monitor", before, after, "--position", ",".join(STATION.split())],
    }
    for name, words in commands.items():
        assert main([*map(str, words), "--out", str(folder / name)]) == 0, name
    part = {**TINY["parts"][0], "train": 0, "val": 0, "test": 1}
    make_dataset(tiny(parts=[part]), folder / "dataset", command=COMMAND)
