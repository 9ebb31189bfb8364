"""Write tables of results into pages of the documentation."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from pipeline.formats.files.atomic import write_text


def write_between(path: Path, marks: tuple[str, str], text: str) -> None:
    """Replace the text between two marks of a document."""
    first, last = marks
    document = path.read_text(encoding="utf-8")
    write_text(path, re.sub(f"{first}.*{last}", lambda _: f"{first}\n{text}\n{last}", document, flags=re.DOTALL))


def printed(rows: Iterable[str]) -> str:
    """Print the rows of a table as they come, and return them as one text."""
    table = []
    for row in rows:
        print(row, flush=True)
        table.append(row)
    return "\n".join(table)
