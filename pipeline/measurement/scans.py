"""Raw scans of any format as this room takes them: points in metres in the files' frame, poses where a header holds them, and
words on what was guessed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.checks import finite
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.points import TEXT, check_reach, placed, read_points
from pipeline.formats.points.ptx import read_ptx
from pipeline.formats.points.xyz import read_table, read_xyz
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
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


def read_scans(path: Path, unit: str = "m", columns: Sequence[str] = ()) -> list[RawScan]:
    """All scans of a file.

    unit: of the file's coordinates; columns: names of a text file's columns. Raises InputError for a format that is not known,
    whatever is wrong in the file, and a scan without points to speak of.
    """
    suffix = path.suffix.lower()
    reader = {".e57": _from_e57, ".ptx": _from_ptx}.get(suffix)
    scans = [_from_text(path, columns)] if suffix in TEXT else list(reader(path)) if reader else [_plain(path)]
    return [_checked(_in_metres(scan, METRES[unit]), str(path)) for scan in scans]


def _plain(path: Path) -> RawScan:
    return RawScan(path.name, read_points(path))


def _from_text(path: Path, columns: Sequence[str]) -> RawScan:
    if columns:
        return RawScan(path.name, read_xyz(path, columns))
    table = read_table(path)
    words = () if table.told else (f"the columns have no names and were taken for {', '.join(table.names)} (else: --columns)",)
    return RawScan(path.name, read_xyz(path, table.names), words=words)


def _from_e57(path: Path) -> Iterator[RawScan]:
    from pipeline.formats.points.e57 import read_e57  # the library takes a tenth of a second to load

    for number, scan in enumerate(read_e57(path), start=1):
        name = f"{path.name} ({number}: {scan.name})"
        if not scan.position.any() and np.array_equal(scan.rotation, np.eye(3)):  # what programs write that know no pose
            yield RawScan(name, scan.cloud, words=("its header holds no pose, or that of the file's own frame",))
        else:
            yield RawScan(name, scan.placed, scan.position, scan.rotation, ("position and rotation are from the E57 header",))


def _from_ptx(path: Path) -> Iterator[RawScan]:
    for number, scan in enumerate(read_ptx(path), start=1):
        rotation, words = orthonormal(scan.rotation, f"{path.name}, scan {number}")
        cloud = placed(replace(scan, rotation=rotation))
        yield RawScan(
            f"{path.name} ({number})", cloud, scan.position, rotation, ("position and rotation are from the PTX header", *words)
        )


def orthonormal(rotation: FloatArray, where: str) -> tuple[FloatArray, tuple[str, ...]]:
    """The nearest rotation matrix to one with few digits, and a word where that changed more than rounding does.

    Raises InputError where it is off by more than a hundredth, or turns left into right.
    """
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max()) if np.abs(rotation).max() < 2 else np.inf
    if off > 0.02 or np.linalg.det(rotation) < 0:
        remedy = "rows must be orthonormal, determinant +1; give more digits"
        raise InputError("the rotation is no rotation matrix", where=where, remedy=remedy)
    left, _, right = np.linalg.svd(rotation)
    words = (f"the rotation was off from orthonormal by {off:.1g} and is made so",) if off > 1e-6 else ()
    return np.asarray(left @ right), words


def _in_metres(scan: RawScan, metres: float) -> RawScan:
    if metres == 1:
        return scan
    cloud = replace(scan.cloud, points=scan.cloud.points * metres)
    return replace(scan, cloud=cloud, position=None if scan.position is None else scan.position * metres)


def _checked(scan: RawScan, where: str) -> RawScan:
    """The scan without points that are no numbers, and with an intensity that is a power."""
    check_reach(scan.cloud.points, where)
    cloud = finite(scan.cloud, where)
    words = list(scan.words)
    if (lost := len(scan.cloud.points) - len(cloud.points)) > 0:
        words.append(f"{lost:,} points that are no numbers are left out")
    if len(cloud.points) < _FEWEST:
        raise InputError(
            f"holds {len(cloud.points)} points", where=where, allowed=f"{_FEWEST} and more", remedy="give a whole scan"
        )
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
