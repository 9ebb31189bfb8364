"""A run's report: what it shows, and the page that it becomes."""

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
"""A longer table of blocks comes folded."""

Statistics = Mapping[str, float | int | None]
"""As DifferenceStatistics.to_dict() gives it: count, median_m, standard_deviation_m, rmse_m, nmad_m, ...; None: no data."""


@dataclass(frozen=True)
class BlockRow:
    """A carved block. size_m: (3,); volumes in m3, measured_volume_m3 None where the map does not show the block;
    position_m: (3,) wall frame; world_position_m: (3,) the wall's own coordinates; annotated: it is in annotations.json."""

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
        """Measured over true volume, minus one."""
        if self.measured_volume_m3 is None or not self.volume_m3:
            return None
        return self.measured_volume_m3 / self.volume_m3 - 1


@dataclass(frozen=True)
class EpochReport:
    """What the report shows of an epoch; pictures are PNG bytes. sigma_m: of the difference map's colour scale; zooms: on blocks;
    registration: RMS of the inliers, m, and iterations, None where epochs are not registered, then convergence is None too."""

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
        return sum(block.annotated for block in self.blocks)

    @property
    def total(self) -> tuple[float, float]:
        """Volume of all blocks together, m3: true, and measured of those that the map shows."""
        return sum(block.volume_m3 for block in self.blocks), sum(block.measured_volume_m3 or 0.0 for block in self.blocks)

    def summary(self) -> str:
        """One sentence in plain words."""
        true, measured = map(litres, self.total)
        volumes = f" of {true} l together, of which the map shows {measured} l" if self.blocks else ""
        carved = f"Epoch {self.number}: {_count(len(self.blocks), 'block')} carved{volumes}, {self.annotated} annotated"
        if self.outside.get("nmad_m") is None:
            return f"{carved}; the difference map has no data outside the blocks."
        noise = f"NMAD {millimetres(self.outside['nmad_m'])} and median {millimetres(self.outside['median_m'])}"
        return f"{carved}; outside the blocks the difference map has {noise}."


@dataclass(frozen=True)
class RegistrationSummary:
    """How the registration ended. rms_m: of the inliers' residuals; reason: why it stopped, in words."""

    rms_m: float
    inliers: int
    points: int
    iterations: int
    reason: str


@dataclass(frozen=True)
class RunReport:
    """What the report of a run shows. sensor: stereo or tls; reference: PNG of its hillshade; key_figures: further rows of the
    table at the top, name to value with its unit; config: resolved; complete: False where the run was interrupted."""

    title: str
    sensor: str
    seed: int
    reference: bytes
    epochs: Sequence[EpochReport]
    config: Mapping[str, Any]
    key_figures: Mapping[str, str] = field(default_factory=dict)
    complete: bool = True

    def summary(self) -> str:
        """What was done, in plain words."""
        sensor = _SENSORS.get(self.sensor, self.sensor)
        end = "" if self.complete else " The run was interrupted: later epochs are missing."
        return f"A {sensor} observed a rock wall before and after rocks fell, in {_count(len(self.epochs), 'epoch')}.{end}"


def write_report(path: Path, report: RunReport) -> None:
    """Write report.html, whole or not at all; equal arguments give equal bytes. Raises InputError where it cannot be written."""
    config = yaml.safe_dump(dict(report.config), sort_keys=False, allow_unicode=True)
    values = {"report": report, "config": config, "scale_sigmas": SCALE_SIGMAS, "unfolded_rows": _UNFOLDED_ROWS}
    page = template("run/report.html.jinja").render(values)
    write_text(path, page)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
