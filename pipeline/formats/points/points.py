"""Point clouds of any format, told by the file's suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.formats.meshes.ply import read_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz
from pipeline.formats.points.ptx import PtxScan, read_ptx
from pipeline.formats.points.xyz import read_xyz
from scene.common.errors import InputError
from scene.common.plug_ins import plugged
from scene.common.regular_file import check_file
from scene.geometry.mesh import FloatArray

PLUG_INS = "scarpsim.readers"
"""The group of entry points by which other packages add readers: named like the suffix, without its dot."""
TEXT = (".xyz", ".txt", ".asc", ".csv", ".pts")
SUFFIXES = (".laz", ".las", ".ply", ".e57", ".ptx", *TEXT)


_LARGEST_M = 1e8
"""No coordinate system of a survey reaches farther, not even one with its origin in the middle of the Earth."""


def read_points(path: Path) -> PointCloud:
    """Read a point cloud; the points of an E57 file are put into the file's frame by the poses in it.

    An E57 file of several scans gives one cloud, with the number of the scan as extra channel `scan`. Points may be NaN or
    infinite, as some programs write what did not return. Raises InputError for a format that is not known, whatever is wrong in
    the file, and coordinates that are none.
    """
    cloud = _read(check_file(path))
    if not len(cloud.points):
        raise InputError("holds no points", where=str(path), remedy="export it again")
    check_reach(cloud.points, str(path))
    return cloud


def check_reach(points: FloatArray, where: str) -> None:
    """Raise InputError where coordinates (n, 3) are no coordinates of a survey; NaN and infinity are let through."""
    known = np.where(np.isfinite(points), np.abs(points), 0.0)
    far = np.flatnonzero((known > _LARGEST_M).any(axis=1))
    if len(far):
        raise InputError(
            f"{len(far):,} of {len(known):,} points have coordinates up to {known.max():.3g} m", where=where,
            allowed=f"at most {_LARGEST_M:g} m", remedy="check the unit (m), and the scale and offset of the file",
        )  # fmt: skip


def _read(path: Path) -> PointCloud:
    suffix = path.suffix.lower()
    if suffix in TEXT:
        return read_xyz(path)
    match suffix:
        case ".laz" | ".las":
            return read_laz(path)
        case ".ply":
            return read_ply_points(path)
        case ".e57":
            return _read_e57(path)
        case ".ptx":
            return joined([placed(scan) for scan in read_ptx(path)])
    further = plugged(PLUG_INS, "a function of a path that returns a PointCloud", callable, [each[1:] for each in SUFFIXES])
    reader = further.get(path.suffix.lower()[1:])
    if reader is None:
        allowed = " ".join([*SUFFIXES, *(f".{name}" for name in further)])
        raise InputError(f"is of an unknown format '{path.suffix}'", where=str(path), allowed=allowed)
    cloud = reader(path)
    if not isinstance(cloud, PointCloud):
        raise InputError(f"reading it gave a {type(cloud).__name__}", where=str(path), allowed="a PointCloud, from its reader")
    return cloud


def _read_e57(path: Path) -> PointCloud:
    from pipeline.formats.points.e57 import read_e57  # the library takes a tenth of a second to load

    return joined([scan.placed for scan in read_e57(path)])


def placed(scan: PtxScan) -> PointCloud:
    """The cloud of a PTX scan in the file's world frame."""
    points = np.einsum("ij,nj->ni", scan.rotation, scan.cloud.points) + scan.position
    return PointCloud(points, scan.cloud.intensity, None, scan.cloud.extra)


def joined(clouds: list[PointCloud]) -> PointCloud:
    """The scans of one file as one cloud."""
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
    )
