"""Define the content of a run's report, and write it as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from pipeline.formats.files.atomic import write_text
from pipeline.report.figures import SCALE_SIGMAS
from pipeline.report.page import litres, millimetres, template

_SENSORS = {"stereo": "stereo pair", "tls": "terrestrial laser scanner"}
_UNFOLDED_ROWS = 60
"""Tables of blocks with more rows than this are folded."""

Statistics = Mapping[str, float | int | None]
"""The result of DifferenceStatistics.to_dict(): count, median_m, standard_deviation_m, rmse_m, nmad_m, ...; None: no data."""


@dataclass(frozen=True)
class BlockRow:
    """One carved block in the report.

    Attributes
    ----------
    label, shape
        As in blocks.json.
    size_m : (3,) sequence
        Lengths of the axes, m.
    volume_m3 : float
        True volume.
    measured_volume_m3 : float or None
        Volume in the difference map; None if the map does not show the block.
    position_m, world_position_m : (3,) sequences
        Position in the wall frame and in world coordinates, m.
    annotated : bool
        Whether it is in annotations.json.
    """

    label: int
    shape: str
    size_m: Sequence[float]
    volume_m3: float
    measured_volume_m3: float | None
    position_m: Sequence[float]
    world_position_m: Sequence[float]
    annotated: bool

    @property
    def relative_error(self) -> float | None:
        """Measured over true volume, minus one; None if the block was not measured."""
        if self.measured_volume_m3 is None or not self.volume_m3:
            return None
        return self.measured_volume_m3 / self.volume_m3 - 1


@dataclass(frozen=True)
class EpochReport:
    """What the report shows of one epoch. Pictures are PNG bytes.

    Attributes
    ----------
    number, points : int
        Number of the epoch, and of its points.
    inside, outside : Statistics
        Statistics of the difference map inside and outside the blocks.
    sigma_m : float
        Noise level that sets the colour scale of the difference map, m.
    blocks : sequence of BlockRow
        The carved blocks.
    hillshade, difference, histogram, convergence, zooms : bytes
        Pictures; convergence is None without registration, zooms None without blocks.
    registration : RegistrationSummary, optional
        How the registration ended.
    """

    number: int
    points: int
    inside: Statistics
    outside: Statistics
    sigma_m: float
    blocks: Sequence[BlockRow]
    hillshade: bytes
    difference: bytes
    histogram: bytes
    convergence: bytes | None = None
    registration: RegistrationSummary | None = None
    zooms: bytes | None = None

    @property
    def annotated(self) -> int:
        """Number of annotated blocks."""
        return sum(block.annotated for block in self.blocks)

    @property
    def total(self) -> tuple[float, float]:
        """True volume of all blocks, m3, and measured volume of those that the map shows."""
        return sum(block.volume_m3 for block in self.blocks), sum(block.measured_volume_m3 or 0.0 for block in self.blocks)

    def summary(self) -> str:
        """Describe the epoch in one or two sentences."""
        true, measured = map(litres, self.total)
        volumes = f" of {true} l together, of which the map shows {measured} l" if self.blocks else ""
        carved = f"Epoch {self.number}: {_count(len(self.blocks), 'block')} carved{volumes}, {self.annotated} annotated"
        if self.outside.get("nmad_m") is None:
            return f"{carved}; the difference map has no data outside the blocks."
        noise = f"NMAD {millimetres(self.outside['nmad_m'])} and median {millimetres(self.outside['median_m'])}"
        return f"{carved}; outside the blocks the difference map has {noise}."


@dataclass(frozen=True)
class RegistrationSummary:
    """How the registration ended. rms_m: RMS of the inliers' residuals, m; reason: why it stopped, in words."""

    rms_m: float
    inliers: int
    points: int
    iterations: int
    reason: str


@dataclass(frozen=True)
class RunReport:
    """What the report of a run shows.

    Attributes
    ----------
    title : str
        Title of the page.
    sensor : str
        "stereo" or "tls".
    seed : int
        Seed of the run.
    reference : bytes
        Hillshade of the reference, PNG.
    epochs : sequence of EpochReport
        The later epochs.
    config : mapping
        The resolved config.
    key_figures : mapping
        Further rows of the table at the top: name to value with its unit.
    complete : bool
        False if the run was interrupted.
    total : int, optional
        Number of later epochs, with those of a series that the page leaves out; None: all are shown.
    """

    title: str
    sensor: str
    seed: int
    reference: bytes
    epochs: Sequence[EpochReport]
    config: Mapping[str, Any]
    key_figures: Mapping[str, str] = field(default_factory=dict)
    complete: bool = True
    total: int | None = None

    def summary(self) -> str:
        """Describe in words what was done."""
        sensor = _SENSORS.get(self.sensor, self.sensor)
        end = "" if self.complete else " The run was interrupted: later epochs are missing."
        total = len(self.epochs) if self.total is None else self.total
        shown = "" if total == len(self.epochs) else f" The page shows the {len(self.epochs)} in which rocks fell."
        return f"A {sensor} observed a rock wall before and after rocks fell, in {_count(total, 'epoch')}.{shown}{end}"


def write_report(path: Path, report: RunReport) -> None:
    """Write report.html completely or not at all. Equal arguments give equal bytes. Raises InputError if it cannot be written."""
    config = yaml.safe_dump(dict(report.config), sort_keys=False, allow_unicode=True)
    values = {"report": report, "config": config, "scale_sigmas": SCALE_SIGMAS, "unfolded_rows": _UNFOLDED_ROWS}
    page = template("run/report.html.jinja").render(values)
    write_text(path, page)


def _count(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural if needed."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
