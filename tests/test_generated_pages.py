"""Pages that are generated from other files, and the random choice of texts that readers review."""

from __future__ import annotations

import importlib
import json
import re
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.readers.draw import COUNTS, PAGE, drawn, everything, page

ROOT = Path(__file__).parents[1]


def test_a_draw_has_its_numbers_and_can_be_repeated() -> None:
    items = drawn(3)
    assert Counter(item["kind"] for item in items) == COUNTS
    assert items == drawn(3)
    assert items != drawn(4)
    assert len({item["where"] for item in items}) == len(items)


def test_every_public_definition_has_a_docstring() -> None:
    without = [each["where"] for each in everything()["definition"] if "(no docstring)" in each["text"]]
    assert len(without) < 50, without


def test_readers_see_the_words_of_messages_instead_of_the_names_of_variables() -> None:
    texts = [each["text"] for each in everything()["message"]]
    bare = [text for text in texts if re.match(r"\w+(;|$)", text)]
    assert len(texts) > 500
    assert len(bare) < 0.02 * len(texts), bare


def test_nearly_every_message_says_what_to_do() -> None:
    every = everything()["message"]
    without = [f"{each['where']} {each['text']}" for each in every if "remedy: " not in each["text"]]
    assert len(without) < 0.05 * len(every), without


def test_the_page_is_that_of_the_grades() -> None:
    assert not PAGE.is_file() or PAGE.read_text(encoding="utf-8") == page()


def test_the_page_of_long_tests_is_that_of_their_list() -> None:
    from make_tests_page import PAGE as OF_TESTS
    from make_tests_page import page as page_of_tests

    assert OF_TESTS.read_text(encoding="utf-8") == page_of_tests()


def test_the_page_of_browser_tests_is_that_of_their_record() -> None:
    from make_browser_page import PAGE as OF_BROWSER
    from make_browser_page import RECORD
    from make_browser_page import page as page_of_browser

    assert OF_BROWSER.read_text(encoding="utf-8") == page_of_browser(json.loads(RECORD.read_text(encoding="utf-8")))


def test_the_pages_of_scripts_run_by_hand_are_those_of_their_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    for name in ("try_install", "mutation"):
        script = importlib.import_module(name)
        record = json.loads(script.RECORD.read_text(encoding="utf-8"))
        assert script.PAGE.read_text(encoding="utf-8") == script.page(record), name
