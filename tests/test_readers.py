"""Items for readers are drawn from all that is public, the same for the same seed."""

from __future__ import annotations

from collections import Counter

from benchmarks.readers.draw import COUNTS, PAGE, definitions, drawn, page


def test_a_draw_has_its_numbers_and_can_be_repeated() -> None:
    items = drawn(3)
    assert Counter(item["kind"] for item in items) == COUNTS
    assert items == drawn(3)
    assert items != drawn(4)
    assert len({item["where"] for item in items}) == len(items)


def test_every_public_definition_has_a_docstring() -> None:
    without = [each["where"] for each in definitions() if "(no docstring)" in each["text"]]
    assert len(without) < 40, without


def test_the_page_is_that_of_the_grades() -> None:
    assert not PAGE.is_file() or PAGE.read_text(encoding="utf-8") == page()
