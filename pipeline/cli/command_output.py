"""What a command tells at its end: text for people, or with --json one document for scripts."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.formats.files.plain_json import without_nan

_OMITTED_KEYS = ("config", "versions")
"""What the records in result folders hold to make them again; too long for a script's standard input."""


@dataclass(frozen=True)
class CommandOutput:
    """The end of a command. text: for people, on stdout; document: gives what --json prints instead; code: exit status."""

    text: str
    document: Callable[[], dict[str, Any]] = field(default=dict)
    code: int = 0


def as_json(document: dict[str, Any]) -> str:
    """The document as JSON; NaN and infinity, which JSON does not know, become null, paths text."""
    return json.dumps(without_nan(document), indent=2, allow_nan=False, default=str)


def record_document(report: Path, record: str) -> Callable[[], dict[str, Any]]:
    """A document made of the JSON file `record` beside a report, without what is only there to make the results again."""

    def document() -> dict[str, Any]:
        values = json.loads((report.parent / record).read_text(encoding="utf-8"))
        kept = {key: value for key, value in values.items() if key not in _OMITTED_KEYS}
        return {"folder": str(report.parent), "report": str(report), **kept}

    return document
