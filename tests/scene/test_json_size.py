"""The memory that a JSON file will need is estimated before it is read, and is limited."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from scene.common import regular_file
from scene.common.errors import InputError
from scene.common.regular_file import read_json

NUMBERS = np.random.default_rng(1).random(40).tolist()
POLYGON = {"id": 1, "bbox": NUMBERS[:4], "area": 80, "segmentation": [NUMBERS]}
PIECES = {
    "numbers": "1.5",
    "whole numbers": "123456",
    "words": '"ab"',
    "words of four bytes a letter": '"a\U0001f600"',
    "lists": "[1.5]",
    "lists in lists": "[[[[[]]]]]",
    "mappings": '{"a":1.5}',
    "mappings of six": json.dumps(dict.fromkeys("abcdef", 1.5)),
    "annotations": json.dumps(POLYGON),
}
WHOLE = {
    "a mapping of other keys each": lambda: json.dumps({str(number): 1.5 for number in range(22_000)}),
    "one long word": lambda: json.dumps("x" * 1_000_000),
    "one of four bytes a letter": lambda: json.dumps("x" * 1_000_000 + "\U0001f600", ensure_ascii=False),
    "one with an escape": lambda: json.dumps("x" * 1_000_000 + "\U0001f600"),
}


@pytest.mark.parametrize("content", [*PIECES, *WHOLE])
def test_what_it_may_take_is_more_than_it_takes(content: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    text = WHOLE[content]() if content in WHOLE else f"[{','.join([PIECES[content]] * 10_000)}]"
    path.write_text(text, encoding="utf-8")
    tracemalloc.start()
    try:
        json.loads(path.read_text(encoding="utf-8"))
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.99 < regular_file._json_gb(path, path.stat().st_size, 10.0) / (taken / 1e9) < 3.0


def test_too_much_is_refused_with_the_limit_that_would_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text(f"[{','.join(['{}'] * 50_000)}]")
    monkeypatch.setattr(regular_file, "MOST_JSON_GB", 0.001)
    with pytest.raises(InputError, match=r"may take 0.0 GB of memory; allowed: up to 0.001 GB; .* SCARPSIM_READ_GB=1$"):
        read_json(path)
    monkeypatch.setenv(regular_file.READ_LIMIT, "1")
    assert len(read_json(path)) == 50_000


def test_gigabytes_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.write(b"[")
        file.truncate(60_000_000_000)
    with pytest.raises(InputError, match=r"may take 120.0 GB of memory; .* SCARPSIM_READ_GB=133"):
        read_json(path)


@pytest.mark.parametrize("given", ["much", "nan", "-1", "0"])
def test_the_limit_is_a_number(given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text("{}")
    monkeypatch.setenv(regular_file.READ_LIMIT, given)
    with pytest.raises(InputError, match="SCARPSIM_READ_GB: the variable is set to"):
        read_json(path)
