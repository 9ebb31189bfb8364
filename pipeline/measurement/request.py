"""The user's request for a measurement folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Request:
    """The raw files of a measurement and what the user says of them.

    Attributes
    ----------
    scans : Files, one for each epoch.
    reference : A file, or "half" for one half of the scan.
    scanner : Name or file of a scanner preset.
    model : File of a sensor model, instead of a preset.
    position : (3,) position of the scanner, m.
    unit, reference_unit : Units of the files' coordinates; None: as each file states, or metres.
    columns : Names of a text file's columns.
    number : Which scan of a file with several, from 1.
    """

    scans: Sequence[Path]
    reference: str
    scanner: str | None = None
    model: Path | None = None
    position: tuple[float, float, float] | None = None
    unit: str | None = None
    reference_unit: str | None = None
    columns: Sequence[str] = ()
    number: int | None = None
