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
    """One carved block, as a row of a table in the report of a run.

    Attributes
    ----------
    label : int
        Number of the block in the epoch, from 1.
    shape : str
        "cube" or "sphere".
    size_m : (3,) sequence
        Lengths of the block's axes, m.
    volume_m3 : float
        True volume of the rock that fell.
    measured_volume_m3 : float or None
        Volume in the difference map; None if the map does not show the block.
    position_m, world_position_m : (3,) sequences
        Centre of the block in the wall frame and in world coordinates, m.
    annotated : bool
        Whether annotations.json, the labels for training, contains the block.
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
        """Relative error of the block's measured volume: measured over true volume, minus one; None if it was not measured."""
        if self.measured_volume_m3 is None or not self.volume_m3:
            return None
        return self.measured_volume_m3 / self.volume_m3 - 1


@dataclass(frozen=True)
class EpochReport:
    """What the report of a run shows of one epoch.

    Attributes
    ----------
    number, points : int
        Number of the epoch, and of its measured points.
    inside, outside : Statistics
        Statistics of the difference map inside and outside the fallen blocks.
    sigma_m : float
        Noise level of the difference map, which sets its colour scale, m.
    blocks : sequence of BlockRow
        The blocks that have fallen.
    hillshade, difference, histogram : bytes
        PNG pictures of the surface, of the difference map, and of the distribution of the differences.
    convergence : bytes, optional
        PNG picture of the registration's residuals by iteration; None without registration.
    registration : RegistrationSummary, optional
        How the registration ended.
    zooms : bytes, optional
        PNG picture of the difference map around the blocks; None without blocks.
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
        """Number of the epoch's blocks that annotations.json, the labels for training, contains."""
        return sum(block.annotated for block in self.blocks)

    @property
    def total(self) -> tuple[float, float]:
        """True volume of all blocks of the epoch, and the measured volume of those that the difference map shows, m3."""
        return sum(block.volume_m3 for block in self.blocks), sum(block.measured_volume_m3 or 0.0 for block in self.blocks)

    def summary(self) -> str:
        """Describe the epoch for the report in a sentence: number and volume of its blocks, and noise of its difference map."""
        true, measured = map(litres, self.total)
        volumes = f" of {true} l together, of which the map shows {measured} l" if self.blocks else ""
        carved = f"Epoch {self.number}: {_count(len(self.blocks), 'block')} carved{volumes}, {self.annotated} annotated"
        if self.outside.get("nmad_m") is None:
            return f"{carved}; the difference map has no data outside the blocks."
        noise = f"NMAD {millimetres(self.outside['nmad_m'])} and median {millimetres(self.outside['median_m'])}"
        return f"{carved}; outside the blocks the difference map has {noise}."


@dataclass(frozen=True)
class RegistrationSummary:
    """How the registration of an epoch to the reference ended, for the report of a run.

    Attributes
    ----------
    rms_m : float
        RMS of the inliers' residuals, m.
    inliers, points : int
        Points kept as inliers, and points used.
    iterations : int
        Number of iterations.
    reason : str
        Why the iteration stopped, in words.
    """

    rms_m: float
    inliers: int
    points: int
    iterations: int
    reason: str


@dataclass(frozen=True)
class RunReport:
    """Everything that report.html of a run shows.

    Attributes
    ----------
    title : str
        Title of the page.
    sensor : str
        "stereo" or "tls".
    seed : int
        Seed of the run's random numbers.
    reference : bytes
        Hillshade of the first epoch, PNG.
    epochs : sequence of EpochReport
        The later epochs that the page shows.
    config : mapping
        The config with all defaults.
    key_figures : mapping
        Further rows of the table at the top: name to value with its unit.
    complete : bool
        False if the run was interrupted.
    total : int, optional
        Number of all later epochs: of a time series the page leaves out those in which nothing fell. None: all are shown.
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
        """Describe the run for the top of its report: sensor, number of epochs, and whether it was interrupted."""
        sensor = _SENSORS.get(self.sensor, self.sensor)
        end = "" if self.complete else " The run was interrupted: later epochs are missing."
        total = len(self.epochs) if self.total is None else self.total
        shown = "" if total == len(self.epochs) else f" The page shows the {len(self.epochs)} in which rocks fell."
        return f"A {sensor} observed a rock wall before and after rocks fell, in {_count(total, 'epoch')}.{shown}{end}"


def write_report(path: Path, report: RunReport) -> None:
    """Write the report of a run as a web page.

    path: the file, report.html; it is complete or absent. report: its content; equal contents give equal bytes. Raises InputError
    if the file cannot be written.
    """
    config = yaml.safe_dump(dict(report.config), sort_keys=False, allow_unicode=True)
    values = {"report": report, "config": config, "scale_sigmas": SCALE_SIGMAS, "unfolded_rows": _UNFOLDED_ROWS}
    page = template("run/report.html.jinja").render(values)
    write_text(path, page)


def _count(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural if needed."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
