"""Every mistake of docs/reference/mistakes.md gives the page's message, in one line, exit status 2, and leaves nothing behind."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
spec = importlib.util.spec_from_file_location("make_mistakes", DOCS / "make_mistakes.py")
assert spec is not None
assert spec.loader is not None
make = importlib.util.module_from_spec(spec)
sys.modules["make_mistakes"] = make
spec.loader.exec_module(make)
PAGE = (DOCS / "reference" / "mistakes.md").read_text(encoding="utf-8")
CHANGING = re.compile(r"[\d.,e+]+ (?:GB|MB)|allowed: [\d.]+ to")
"""Depends on the machine's free memory."""


@pytest.fixture(scope="module", autouse=True)
def playground() -> Iterator[None]:
    with make.playground():
        yield


@pytest.mark.parametrize("mistake", make.MISTAKES, ids=[mistake.what for mistake in make.MISTAKES])
def test_a_mistake_is_answered_as_the_page_says(mistake: object) -> None:
    code, out, message = make.answer(mistake)
    assert (code, out) == (2, "")
    assert message.startswith("error: ")
    assert "\n" not in message
    assert "Traceback" not in message
    assert len(message) < 1000
    assert not Path("out").exists()
    assert not Path("harm").exists()
    assert CHANGING.sub("*", message) in CHANGING.sub("*", PAGE)


def test_nothing_in_use_was_touched() -> None:
    assert [path.name for path in Path("used").iterdir()] == ["mine.txt"]
    assert Path("site.yaml").read_text() == make.SITE


def test_the_page_shows_every_mistake() -> None:
    assert len(make.MISTAKES) >= 20
    assert all(f"**{mistake.what}**" in PAGE for mistake in make.MISTAKES)
