"""Chromium for the tests of what a person looks at, and small outputs of the commands that make a page."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_pages import WIDE, WatchedPage, make_outputs
from browser_record import RECORD
from shared_outputs import build_site, made_once

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"


@pytest.fixture(scope="module")
def tab() -> Iterator[Any]:
    """Playwright's page in Chromium without network.

    It is opened once for a module, because a new one takes a second. It does not outlive the module, because Playwright's event
    loop would disturb those of other tests.
    """
    if CHROMIUM is None:
        pytest.skip(
            "there is no Chromium on this machine; `make setup-all` installs it if it has the right to install system packages"
        )
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, OFFLINE])
        RECORD.chromium = chromium.version
        yield chromium.new_context(viewport={"width": WIDE, "height": 900}, reduced_motion="reduce").new_page()
        chromium.close()


@pytest.fixture
def page(tab: Any, request: pytest.FixtureRequest) -> Iterator[WatchedPage]:
    """Return an empty page; whatever its console, its network or its scripts complained of fails the test at the end."""
    watched = WatchedPage(tab)
    yield watched
    watched.close()
    RECORD.add(request.node.name, watched.tally)
    RECORD.axe = watched.axe or RECORD.axe
    assert not watched.complaints


@pytest.fixture(scope="session")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the outputs of each command, by its name."""
    return made_once(tmp_path_factory, "outputs", make_outputs)


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built documentation."""
    return made_once(tmp_path_factory, "site", build_site)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the record of what was done and found, where BROWSER_RECORD names a file for it."""
    if (path := os.environ.get("BROWSER_RECORD")) and RECORD.tallies:
        RECORD.write(Path(path), session.testsfailed)
