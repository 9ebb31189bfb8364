"""The count of noticed faults: every place holds one fault that compiles, the draw can be repeated, and the page counts."""

from __future__ import annotations

import ast

import mutation
import pytest

SOURCE = '''"""A module."""
LIMIT: float = 3.0

def clipped(value, low=True):
    """Return a value within the limit."""
    if value < LIMIT and low:
        return value + 1
    raise ValueError(f"{value} is over {LIMIT + 1}")
'''


def test_each_fault_changes_one_place_and_spares_words() -> None:
    found = [(line, mutation.changed_source(SOURCE, number)) for line, number in mutation.places(SOURCE)]
    whole = ast.unparse(ast.parse(SOURCE))
    assert len({text for _, text in found} - {whole}) == len(found)
    assert {line for line, _ in found} == {2, 4, 6, 7}
    assert any("LIMIT: float = 6.0" in text for _, text in found)
    assert any("value <= LIMIT" in text for _, text in found)
    assert any("value < LIMIT or low" in text for _, text in found)
    assert any("not (value < LIMIT and low)" in text for _, text in found)
    assert any("value - 1" in text for _, text in found)
    assert all('f"' in text or "f'" in text for _, text in found)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_draw_can_be_repeated(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mutation, "PARTS", ("pipeline/change",))
    drawn = mutation.drawn(5, seed)
    assert drawn == mutation.drawn(5, seed)
    assert len({(each.file, each.line) for each in drawn}) == 5
    assert all(each.before != each.after for each in drawn)


def test_the_page_counts() -> None:
    place = {"file": "scene/a.py", "line": 3, "number": 1, "before": "a | b", "after": "a & b"}
    outcomes = [{"mutation": place, "said": said, "test": ""} for said in ("caught", "caught", "survived")]
    parts = {"scene": {"num_statements": 200, "covered_lines": 150, "num_branches": 10, "covered_branches": 5}}
    record = {"reach": {"commit": "abc", "tests": ["tests"], "parts": parts}}
    text = mutation.page(record | {"mutate": {"commit": "abc", "seed": 1, "outcomes": outcomes}})
    assert "**2 of 3 faults were noticed.**" in text
    assert "| `scene` | 200 | 75 % | 10 | 50 % |" in text
    assert "| `scene/a.py:3` | `a \\| b` | `a & b` | survived |" in text
