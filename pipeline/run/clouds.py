"""Write an epoch's points in each format. The module is imported when the first points are written: its libraries load slowly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.formats.meshes.ply import write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.copc import SUFFIX as COPC
from pipeline.formats.points.copc import write_copc
from pipeline.formats.points.e57 import E57Scan, write_e57
from pipeline.formats.points.laz import LazHeader, PulseChannels, write_laz
from pipeline.formats.points.pcd import write_pcd
from pipeline.formats.points.xyz import write_xyz

_HEADER = LazHeader()


def write_formats(
    stem: Path, formats: Sequence[str], cloud: PointCloud, scans: Callable[[], list[E57Scan]], header: LazHeader
) -> None:
    """Write a point cloud in the formats that the config asks for besides LAZ.

    Parameters
    ----------
    stem : Path
        Path of the files without their ending.
    formats : sequence of str
        Names of the formats: "copc", "ply", "xyz", "pcd" or "e57".
    cloud : PointCloud
        The points.
    scans : callable
        Returns the scans for an E57 file; only called if that is asked for.
    header : LazHeader
        Coordinate system and date for COPC.
    """
    if "copc" in formats:
        write_cloud(stem.with_suffix(COPC), cloud, header)
    if "ply" in formats:
        write_ply_points(stem.with_suffix(".ply"), cloud)
    if "xyz" in formats:
        write_xyz(stem.with_suffix(".xyz"), cloud)
    if "pcd" in formats:
        write_pcd(stem.with_suffix(".pcd"), cloud)
    if "e57" in formats:
        write_e57(stem.with_suffix(".e57"), scans())


def write_cloud(path: Path, cloud: PointCloud, header: LazHeader = _HEADER) -> None:
    """Write a point cloud as LAZ, or as COPC if `path` ends in .copc.laz.

    The extra channels `return_number`, `number_of_returns` and `scan_angle_rad` go into the fields that LAZ has for them, all
    others into extra dimensions.

    header: coordinate system and date of the file. Raises InputError if the file cannot be written, or for a COPC file without
    points.
    """
    extra = dict(cloud.extra)
    pulses = PulseChannels(*(extra.pop(name, None) for name in ("return_number", "number_of_returns", "scan_angle_rad")))
    write = write_copc if path.name.lower().endswith(COPC) else write_laz
    write(path, replace(cloud, extra=extra), pulses, header)
