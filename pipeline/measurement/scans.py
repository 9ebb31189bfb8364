"""Read raw scans of any format: points in metres in the file's frame, the scanner's pose if the header has it, and notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.finite import finite
from pipeline.formats.points.points import read_placed_scans
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_OF_GRID = {"row", "column", "line", "scan", "pixel_x", "pixel_y"}
"""Channels of the scan's grid."""
_OF_RETURNS = {"return_number", "number_of_returns", "return_index", "return_count"}
"""Channels of returns. A measurement uses these, those of the grid, intensity and time."""
_FEWEST = 100
"""Smallest number of points in a scan."""


@dataclass(frozen=True)
class RawScan:
    """One laser scan or cloud of a file, with what the file states of the scanner.

    Attributes
    ----------
    name : Name of the scan.
    cloud : Points with finite coordinates, m, in the file's frame; intensity from 0 up.
    position : (3,) position of the scanner, file's frame, m; None if the file does not state it.
    rotation : (3, 3) rotation from the scanner's frame to the file's frame; None if the file does not state it.
    words : What was assumed or changed when the file was read, for the user.
    """

    name: str
    cloud: PointCloud
    position: FloatArray | None = None
    rotation: FloatArray | None = None
    words: tuple[str, ...] = ()

    def part(self, rows: NDArray[Any]) -> RawScan:
        """Return the scan with only the points that `rows` selects: their indices (k,), or a mask (n,)."""
        return replace(self, cloud=part_of(self.cloud, rows))


def part_of(cloud: PointCloud, rows: NDArray[Any]) -> PointCloud:
    """Return the points of a cloud that `rows` selects (indices (k,) or a mask (n,)), with intensity, time and other channels."""
    return PointCloud(
        cloud.points[rows],
        None if cloud.intensity is None else cloud.intensity[rows],
        None if cloud.gps_time is None else cloud.gps_time[rows],
        {name: channel[rows] for name, channel in cloud.extra.items()},
    )


def read_scans(
    path: Path, unit: str | None = None, columns: Sequence[str] = (), option: str = "--unit", *, only_points: bool = False
) -> list[RawScan]:
    """Read all laser scans or clouds of a point file, in metres.

    Parameters
    ----------
    path : LAS, LAZ, PLY, E57, PTX or text file, or one of a format that a plug-in reads.
    unit : Unit of the coordinates, such as "mm"; None: as the file states, or metres.
    columns : Names of the columns of a text file, in order; empty: as the file states.
    option : Command-line option that gives the unit, for errors.
    only_points : Whether intensity, times and other channels may be left out, which saves time for LAS and LAZ files.

    Raises
    ------
    InputError
        If the format is unknown, the file is wrong, or a scan has fewer than 100 points.
    """
    scans = read_placed_scans(path, unit, columns, option, only_points=only_points)
    raw = (RawScan(scan.name, scan.cloud, scan.position, scan.rotation, scan.cloud.notes) for scan in scans)
    return [_checked(scan, str(path)) for scan in raw]


def _checked(scan: RawScan, where: str) -> RawScan:
    """Remove points that are not finite, and convert the intensity to a power."""
    cloud = finite(scan.cloud, where)
    words = list(scan.words)
    if (lost := len(scan.cloud.points) - len(cloud.points)) > 0:
        note = f"{lost:,} points with coordinates that are not numbers are left out"
        cloud, words = cloud.noted(note), [*words, note]
    if len(cloud.points) < _FEWEST:
        raise InputError(
            f"the scan has only {len(cloud.points)} points",
            where=where,
            allowed=f"{_FEWEST} or more",
            remedy="export the whole scan",
        )
    if unused := sorted(set(cloud.extra) - _OF_GRID - _OF_RETURNS):
        words.append(f"the file also has {', '.join(unused)}, which {'is' if len(unused) == 1 else 'are'} not used")
    if cloud.intensity is not None:
        power, said = _power(np.asarray(cloud.intensity, dtype=np.float64))
        cloud = replace(cloud, intensity=power)
        words.extend(said)
    return replace(scan, cloud=cloud, words=tuple(words))


def _power(intensity: FloatArray) -> tuple[FloatArray | None, list[str]]:
    """Convert intensity (n,) to a received power, with notes on how.

    Decibels become 10^(dB / 10); from other negative numbers their minimum is subtracted.
    """
    low, high = float(intensity.min()), float(intensity.max())
    if low == high:
        return None, ["the intensity is constant and left out"]
    if low >= 0:
        return intensity, ["intensity is used unchanged; the manufacturer's numbers need not be proportional to received power"]
    if low > -60 and high < 60:
        return 10 ** (intensity / 10), ["the intensity has values below 0 and was read as decibels: 10^(dB / 10)"]
    return intensity - low, [f"the intensity has values below 0; its minimum, {low:g}, was read as zero power"]
