"""What is asked for of raw files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Request:
    """What is asked for. scans: files, each an epoch; reference: a file, or `half`; scanner: a preset's name or file, or model: a
    file model.yaml; position: (3,) m; unit, reference_unit: of the files' coordinates, None: as each file states, metres where it
    states none; columns: of text files; number: which scan
    of a file of several, from 1."""

    scans: Sequence[Path]
    reference: str
    scanner: str | None = None
    model: Path | None = None
    position: tuple[float, float, float] | None = None
    unit: str | None = None
    reference_unit: str | None = None
    columns: Sequence[str] = ()
    number: int | None = None
