"""The user's request for a measurement folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scene.common.errors import InputError


@dataclass(frozen=True)
class Request:
    """The raw files from which a measurement folder is to be made, and what the user says of them.

    Attributes
    ----------
    scans : Files of measured points, one for each epoch.
    reference : File of the reference surface, or "half" to compare one half of the scan with the other.
    scanner : Name or file of a scanner preset, which gives the noise model.
    model : File of a sensor model, instead of a preset.
    position : (3,) position of the scanner, frame of the files, m; for clouds from photographs any place in front of the wall.
        None: unknown.
    unit, reference_unit : Units of the coordinates of scans and reference, such as "mm"; None: as each file states, or metres.
    columns : Names of the columns of text files, in order; empty: as each file states.
    number : Which scan to use of a file with several, from 1; None: all.
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

    def check_reference(self) -> None:
        """Raise InputError if the reference is the file of a scan, because nothing differs from itself."""
        reference = Path(self.reference)
        for scan in self.scans:
            if scan.exists() and reference.exists() and scan.samefile(reference):
                raise InputError(
                    "the reference is the scan itself, so that they cannot differ",
                    where=f"--reference {self.reference}",
                    allowed="a mesh, a DEM, the scan of another epoch, or the word half for laser scans",
                    remedy="give another file as the reference",
                )
