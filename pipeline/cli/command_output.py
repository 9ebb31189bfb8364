"""Define what a command prints at its end: text for people or, with --json, one JSON document for scripts."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.formats.files.plain_json import without_nan

_OMITTED_KEYS = ("config", "versions")
"""Keys of the record files that --json leaves out. They only serve to repeat the run and are long."""


@dataclass(frozen=True)
class CommandOutput:
    """What a finished command prints, and its exit status.

    Attributes
    ----------
    text : str
        Text for people, printed on stdout.
    document : function
        Returns the document that --json prints instead of the text.
    code : int
        Exit status.
    """

    text: str
    document: Callable[[], dict[str, Any]] = field(default=dict)
    code: int = 0


def as_json(document: dict[str, Any]) -> str:
    """Return a document as JSON text; NaN and infinity, which JSON does not know, become null, and paths become text."""
    return json.dumps(without_nan(document), indent=2, allow_nan=False, default=str)


def record_document(report: Path, record: str) -> Callable[[], dict[str, Any]]:
    """Return a function that gives what --json prints of a finished command.

    report: path of the report. record: name of the JSON file next to it, such as run.json; its keys config and versions, which
    only
    serve to repeat the run, are left out.
    """

    def document() -> dict[str, Any]:
        values = json.loads((report.parent / record).read_text(encoding="utf-8"))
        kept = {key: value for key, value in values.items() if key not in _OMITTED_KEYS}
        return {"folder": str(report.parent), "report": str(report), **kept}

    return document
