"""Read point clouds of any format, by the file's suffix; all commands and functions read points through this module."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.formats.meshes.ply import read_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.fillers import without_fillers
from pipeline.formats.points.ptx import orthonormal, read_ptx
from pipeline.formats.points.xyz import read_xyz
from pipeline.formats.units import AxisUnits, agreed_units
from scene.common.errors import InputError
from scene.common.plug_ins import load_plug_ins
from scene.common.regular_file import check_file
from scene.geometry.bounds import bounding_box
from scene.geometry.mesh import FloatArray

PLUG_INS = "scarpsim.readers"
"""Group of entry points by which other packages add readers, named like the suffix without its dot."""
TEXT = (".xyz", ".txt", ".asc", ".csv", ".pts")
"""Suffixes of text files."""
SUFFIXES = (".laz", ".las", ".ply", ".e57", ".ptx", *TEXT)
"""Suffixes of all formats."""
_LARGEST_M = 1e8
"""Largest coordinate, m; no survey's coordinate system reaches farther, even with its origin at the centre of the Earth."""


@dataclass(frozen=True)
class PlacedScan:
    """One scan of a point cloud file, with the scanner's pose if the file states it.

    Attributes
    ----------
    name : Name of the scan.
    cloud : Points in the file's frame.
    position : (3,) position of the scanner in the file's frame; None if the file does not state it.
    rotation : (3, 3) scanner to the file's frame; None if the file does not state it.
    """

    name: str
    cloud: PointCloud
    position: FloatArray | None = None
    rotation: FloatArray | None = None

    def in_metres(self, units: AxisUnits) -> PlacedScan:
        """Return the scan with its points and position converted to metres. units: those of its coordinates."""
        if units.in_metres:
            return replace(self, cloud=replace(self.cloud, stated_units=None))
        factors = units.factors()
        note = f"the coordinates were converted from {units.name} by {units.source}"
        cloud = replace(self.cloud, points=self.cloud.points * factors, stated_units=None).noted(note)
        position = None if self.position is None else self.position * factors
        return replace(self, cloud=cloud, position=position)


def read_points(path: Path) -> PointCloud:
    """Read a point cloud from a file of any known format, in the file's frame, m.

    Several scans in a file (E57, PTX) are converted to its frame by their poses and give one cloud, with the number of the scan
    in the extra channel `scan`. Points may be NaN or infinite, as some programs write missing returns. Raises InputError as
    `read_placed_scans` does.
    """
    return joined([scan.cloud for scan in read_placed_scans(path)])


def read_placed_scans(
    path: Path, unit: str | None = None, columns: Sequence[str] = (), option: str = "--unit", *, only_points: bool = False
) -> list[PlacedScan]:
    """Read all laser scans of a point cloud file, in metres and without points that stand for a missing return.

    Parameters
    ----------
    path : File in LAS, LAZ, PLY, E57, PTX or text format, or in one that a plug-in reads.
    unit : Name of the coordinates' unit, such as "mm"; None: as the file states, or metres.
    columns : Names of a text file's columns, instead of the file's own.
    option : Command-line option that gives the unit, for errors.
    only_points : Whether intensity, times and other channels may be left out, which saves time for LAS and LAZ files.

    Raises
    ------
    InputError
        If the format is unknown, the file is wrong or contradicts the unit, or coordinates are impossible.
    """
    where = str(check_file(path))
    scans = _read(path, columns, only_points)
    if not any(len(scan.cloud.points) for scan in scans):
        raise InputError("the file has no points", where=where, remedy="export the file again, with its points")
    found = []
    for scan in scans:
        units = agreed_units(scan.cloud.stated_units, unit, where, option)
        found.append(scan.in_metres(units))
        check_reach(found[-1].cloud.points, where)
    return found


def check_reach(points: FloatArray, where: str) -> None:
    """Raise InputError if coordinates (n, 3), m, are too large for a survey; NaN and infinity pass. where: name of the file."""
    if len(points) and np.abs(bounding_box(points)).max() <= _LARGEST_M:
        return
    known = np.where(np.isfinite(points), np.abs(points), 0.0)
    far = np.flatnonzero((known > _LARGEST_M).any(axis=1))
    if len(far):
        raise InputError(
            f"{len(far):,} of {len(known):,} points have coordinates up to {known.max():.3g} m", where=where,
            allowed=f"at most {_LARGEST_M:g} m", remedy="export the points in metres, or correct "
            "the scale and offset in the header",
        )  # fmt: skip


def _read(path: Path, columns: Sequence[str], only_points: bool) -> list[PlacedScan]:
    """Return the scans in the file's unit, without fillers."""
    suffix, where = path.suffix.lower(), str(path)
    if suffix == ".e57":
        return _read_e57(path)
    if suffix == ".ptx":
        return _read_ptx(path)
    if suffix in TEXT:
        cloud = read_xyz(path, columns)
    elif suffix in (".laz", ".las"):
        from pipeline.formats.points.laz import read_laz  # laspy takes a fifth of a second to load

        cloud = read_laz(path, only_points=only_points)
    elif suffix == ".ply":
        cloud = read_ply_points(path)
    else:
        cloud = _read_plugged(path)
    return [PlacedScan(path.name, without_fillers(cloud, where))]


def _read_plugged(path: Path) -> PointCloud:
    """Read a cloud by another package's reader."""
    further = load_plug_ins(PLUG_INS, "a function of a path that returns a PointCloud", callable, [each[1:] for each in SUFFIXES])
    reader = further.get(path.suffix.lower()[1:])
    if reader is None:
        allowed = " ".join([*SUFFIXES, *(f".{name}" for name in further)])
        raise InputError(
            f"unknown format '{path.suffix}'",
            where=str(path),
            allowed=allowed,
            remedy="export the points in one of these formats",
        )
    cloud = reader(path)
    if not isinstance(cloud, PointCloud):
        raise InputError(
            f"the reader of this format returned a {type(cloud).__name__}",
            where=str(path),
            allowed="a PointCloud",
            remedy="correct the reader in the package that provides it",
        )
    return cloud


def _read_e57(path: Path) -> list[PlacedScan]:
    """Read the scans of an E57 file."""
    from pipeline.formats.points.e57 import read_e57  # the library takes a tenth of a second to load

    found = []
    for number, scan in enumerate(read_e57(path), start=1):
        name = f"{path.name} ({number}: {scan.name})"
        scan = replace(scan, cloud=without_fillers(scan.cloud, name, grid=True))
        if not scan.position.any() and np.array_equal(scan.rotation, np.eye(3)):  # programs write this if they know no pose
            found.append(PlacedScan(name, scan.cloud.noted("its header has no pose, or that of the file's own frame")))
        else:
            cloud = scan.placed.noted("position and rotation are from the E57 header")
            found.append(PlacedScan(name, cloud, scan.position, scan.rotation))
    return found


def _read_ptx(path: Path) -> list[PlacedScan]:
    """Read the scans of a PTX file."""
    found = []
    for number, scan in enumerate(read_ptx(path), start=1):
        rotation, words = orthonormal(scan.rotation, f"{path.name}, scan {number}")
        name = f"{path.name} ({number})"
        cloud = without_fillers(scan.cloud, name, grid=True).noted("position and rotation are from the PTX header", *words)
        cloud = replace(cloud, points=np.einsum("ij,nj->ni", rotation, cloud.points) + scan.position)
        found.append(PlacedScan(name, cloud, scan.position, rotation))
    return found


def joined(clouds: list[PointCloud]) -> PointCloud:
    """Join the scans of one file to one cloud, with the number of the scan in the extra channel `scan`."""
    if len(clouds) == 1:
        return clouds[0]
    shared = set.intersection(*(set(cloud.extra) for cloud in clouds))
    extra = {name: np.concatenate([cloud.extra[name] for cloud in clouds]) for name in clouds[0].extra if name in shared}
    extra["scan"] = np.repeat(np.arange(len(clouds)), [len(cloud.points) for cloud in clouds])
    intensities = [cloud.intensity for cloud in clouds if cloud.intensity is not None]
    times = [cloud.gps_time for cloud in clouds if cloud.gps_time is not None]
    return PointCloud(
        points=np.concatenate([cloud.points for cloud in clouds]),
        intensity=np.concatenate(intensities) if len(intensities) == len(clouds) else None,
        gps_time=np.concatenate(times) if len(times) == len(clouds) else None,
        extra=extra,
        notes=tuple(dict.fromkeys(note for cloud in clouds for note in cloud.notes)),
    )
