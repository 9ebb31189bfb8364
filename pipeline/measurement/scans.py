"""Raw scans of any format as this room takes them: points in metres in the files' frame, poses where a header holds them, and
words on what was guessed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.checks import finite
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.points import read_placed_scans
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_OF_GRID = {"row", "column", "line", "scan", "pixel_x", "pixel_y"}
_OF_RETURNS = {"return_number", "number_of_returns", "return_index", "return_count"}
"""Channels that a measurement is made of, beside intensity and time."""
_FEWEST = 100
"""Points below which nothing can be said of a scan."""


@dataclass(frozen=True)
class RawScan:
    """One scan. cloud: finite points, m, in the file's frame (intensity from 0 up); position: (3,) m, rotation: (3, 3), scanner
    to the file's frame, None where the file does not say; words: what was guessed or changed."""

    name: str
    cloud: PointCloud
    position: FloatArray | None = None
    rotation: FloatArray | None = None
    words: tuple[str, ...] = ()

    def part(self, rows: NDArray[Any]) -> RawScan:
        """The scan with some of its points."""
        return replace(self, cloud=part_of(self.cloud, rows))


def part_of(cloud: PointCloud, rows: NDArray[Any]) -> PointCloud:
    """Some points (indices, or a mask) of a cloud."""
    return PointCloud(
        cloud.points[rows],
        None if cloud.intensity is None else cloud.intensity[rows],
        None if cloud.gps_time is None else cloud.gps_time[rows],
        {name: channel[rows] for name, channel in cloud.extra.items()},
    )


def read_scans(path: Path, unit: str | None = None, columns: Sequence[str] = (), option: str = "--unit") -> list[RawScan]:
    """Read all scans of a file.

    Parameters
    ----------
    path : of any format that `read_placed_scans` reads
    unit : of the file's coordinates; None: as the file states, metres where it states none
    columns : names of a text file's columns
    option : by which the user gives the unit, for errors

    Raises
    ------
    InputError
        For a format that is not known, whatever is wrong in the file, and a scan without points to speak of.
    """
    scans = read_placed_scans(path, unit, columns, option)
    raw = (RawScan(scan.name, scan.cloud, scan.position, scan.rotation, scan.cloud.notes) for scan in scans)
    return [_checked(scan, str(path)) for scan in raw]


def _checked(scan: RawScan, where: str) -> RawScan:
    """The scan without points that are no numbers, and with an intensity that is a power."""
    cloud = finite(scan.cloud, where)
    words = list(scan.words)
    if (lost := len(scan.cloud.points) - len(cloud.points)) > 0:
        words.append(f"{lost:,} points that are no numbers are left out")
    if len(cloud.points) < _FEWEST:
        raise InputError(
            f"holds {len(cloud.points)} points", where=where, allowed=f"{_FEWEST} and more", remedy="give a whole scan"
        )
    if unused := sorted(set(cloud.extra) - _OF_GRID - _OF_RETURNS):
        words.append(f"the file also holds {', '.join(unused)}, which {'is' if len(unused) == 1 else 'are'} not used")
    if cloud.intensity is not None:
        power, said = _power(np.asarray(cloud.intensity, dtype=np.float64))
        cloud = replace(cloud, intensity=power)
        words.extend(said)
    return replace(scan, cloud=cloud, words=tuple(words))


def _power(intensity: FloatArray) -> tuple[FloatArray | None, list[str]]:
    """Intensity as it may stand for received power: decibels as 10^(dB / 10), numbers with an offset from their least."""
    low, high = float(intensity.min()), float(intensity.max())
    if low == high:
        return None, ["the intensity is the same everywhere and left out"]
    if low >= 0:
        return intensity, ["intensity is taken as it stands: the maker's numbers need not be proportional to received power"]
    if low > -60 and high < 60:
        return 10 ** (intensity / 10), ["the intensity has values below 0 and was taken for decibels: 10^(dB / 10)"]
    return intensity - low, [f"the intensity has values below 0: its least, {low:g}, was taken for no power"]
