"""Compare the page of checks with what the commands do.

Each kind of fault is found by each command, and a good file is accepted.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from make_checks import KINDS, NO_FAULT, PAGE, REFUSED, TAKEN, Kind, outcome, prepare, table

CASES = [(kind, reader, fault) for kind in KINDS for reader in kind.readers for fault in kind.faults]


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    prepare(tmp_path)


@pytest.mark.parametrize(
    ("kind", "reader", "fault"), CASES, ids=[f"{kind.title}, {reader}, {fault}" for kind, reader, fault in CASES]
)
def test_every_reader_refuses_every_fault(kind: Kind, reader: str, fault: str) -> None:
    assert outcome(kind, reader, fault) == REFUSED


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.good is not None], ids=lambda kind: kind.title)
def test_a_file_without_a_fault_gets_through(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a command that refuses everything would seem to check everything."""
    for number, reader in enumerate(reader for reader in kind.readers if reader not in kind.long):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        prepare(folder)
        assert outcome(kind, reader, NO_FAULT) == (REFUSED if reader in kind.refusing else TAKEN), reader


def test_the_page_has_every_cell() -> None:
    page = PAGE.read_text()
    for kind in KINDS:
        assert table(kind, {(reader, fault): REFUSED for reader in kind.readers for fault in kind.faults}) in page
