"""Public reports about point clouds: LAS, E57, PTX, PTS, PLY."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pye57
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct
from pye57 import libe57

from benchmarks.field_reports.report import Report, points_of_wall, refused, refused_by_command, same_points
from pipeline.formats.meshes.ply import read_ply_points
from pipeline.formats.points.points import read_placed_scans, read_points
from scene.geometry.mesh import FloatArray

_US_FOOT_M = 1200.0 / 3937.0


def _las(path: Path, points: FloatArray, change: Callable[[Any], None] = lambda las: None, **header: Any) -> Path:
    head = laspy.LasHeader(**({"point_format": 6, "version": "1.4"} | header))
    head.scales, head.offsets = np.full(3, 1e-3), np.floor(points.min(axis=0))
    las = laspy.LasData(head)
    las.x, las.y, las.z = points.T
    change(las)
    las.write(str(path))
    return path


def _patch(path: Path, place: int, layout: str, *values: int) -> None:
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, place, *values)
    path.write_bytes(bytes(data))


def _cut_las(folder: Path) -> str:
    path = _las(folder / "scan.las", points_of_wall())
    path.write_bytes(path.read_bytes()[:-3001])
    return refused(lambda: read_points(path), folder, "600 points", "cut off")


def _cut_laz(folder: Path) -> str:
    path = _las(folder / "scan.laz", points_of_wall())
    _patch(path, 247, "<Q", 611)  # the header's count of points, LAS 1.4
    _patch(path, 107, "<I", 611)
    return refused(lambda: read_points(path), folder, "scan.laz")


def _undeclared_bytes(folder: Path) -> str:
    """Write records of 34 bytes where the point format has 30, without declaring the other four."""
    points = points_of_wall()
    path = folder / "scan.las"
    _las(path, points, lambda las: las.add_extra_dim(laspy.ExtraBytesParams("reflectance", "f4")))
    with laspy.open(path) as reader:
        vlr_start, data_start = reader.header.version.minor and 375, reader.header.offset_to_point_data
    data = path.read_bytes()
    head = bytearray(data[:vlr_start])
    struct.pack_into("<II", head, 96, vlr_start, 0)  # no variable-length records
    path.write_bytes(bytes(head) + data[data_start:])
    return same_points(read_points(path).points, points)


def _flag_of_wkt_unset(folder: Path) -> str:
    """Point format 6 with its coordinate system as GeoTIFF keys, in US survey feet, and the flag for WKT not set."""
    points = points_of_wall()

    def change(las: Any) -> None:
        record = GeoKeyDirectoryVlr()
        record.geo_keys = [
            GeoKeyEntryStruct(id=number, tiff_tag_location=0, count=1, value_offset=value)
            for number, value in ((1024, 1), (3076, 9003), (4099, 9003))
        ]
        record.geo_keys_header.number_of_keys = len(record.geo_keys)
        las.header.vlrs.append(record)
        las.header.global_encoding.wkt = False

    path = _las(folder / "scan.las", points / _US_FOOT_M, change)
    (scan,) = read_placed_scans(path)
    return same_points(scan.cloud.points, points) + ", converted from US survey feet"


def _return_number_zero(folder: Path) -> str:
    def change(las: Any) -> None:
        las.return_number[:] = 0
        las.number_of_returns[:] = 0

    points = points_of_wall()
    return same_points(read_points(_las(folder / "scan.las", points, change)).points, points)


def _version_1_0(folder: Path) -> str:
    """Write a file of version 1.0, whose bytes behind the header are no count of points."""
    points = points_of_wall()
    path = _las(folder / "scan.las", points, version="1.2", point_format=0)
    _patch(path, 24, "<BB", 1, 0)
    return same_points(read_points(path).points, points)


def _no_older_count(folder: Path) -> str:
    points = points_of_wall()
    path = _las(folder / "scan.las", points)
    _patch(path, 107, "<6I", *[0] * 6)
    return same_points(read_points(path).points, points)


def _noise_classes(folder: Path) -> str:
    points = points_of_wall()

    def change(las: Any) -> None:
        las.classification[:20] = 7
        las.classification[20:50] = 18

    cloud = read_points(_las(folder / "scan.las", points, change))
    assert any("noise" in note for note in cloud.notes), cloud.notes
    return same_points(cloud.points, points[50:]) + " but those of classes 7 and 18, and says so"


def _las_named_xyz(folder: Path) -> str:
    path = _las(folder / "scan.las", points_of_wall())
    path = path.rename(folder / "scan.xyz")
    return refused(lambda: read_points(path), folder, "LAS or LAZ file")


# --- E57


def _e57(path: Path, fields: dict[str, FloatArray], pose: dict[str, tuple[float, ...]] | None = None) -> Path:
    """Write a file of one scan with the given fields, 64-bit numbers, and parts of a pose."""
    image = libe57.ImageFile(str(path), "w")
    root = image.root()
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(image, "{00000000-0000-0000-0000-000000000000}"))
    root.set("versionMajor", libe57.IntegerNode(image, 1))
    root.set("versionMinor", libe57.IntegerNode(image, 0))
    data = libe57.VectorNode(image, True)
    root.set("data3D", data)
    scan, layout = libe57.StructureNode(image), libe57.StructureNode(image)
    scan.set("guid", libe57.StringNode(image, "{00000000-0000-0000-0000-000000000001}"))
    for name in fields:
        layout.set(name, libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE))
    if pose is not None:
        node = libe57.StructureNode(image)
        for part, values in pose.items():
            numbers = libe57.StructureNode(image)
            for axis, value in zip("wxyz" if len(values) == 4 else "xyz", values, strict=True):
                numbers.set(axis, libe57.FloatNode(image, value, libe57.E57_DOUBLE))
            node.set(part, numbers)
        scan.set("pose", node)
    points = libe57.CompressedVectorNode(image, layout, libe57.VectorNode(image, True))
    scan.set("points", points)
    data.append(scan)
    buffers = libe57.VectorSourceDestBuffer()
    kept = {name: np.ascontiguousarray(values, dtype=np.float64) for name, values in fields.items()}
    for name, values in kept.items():
        buffers.append(libe57.SourceDestBuffer(image, name, values, len(values), True, True))
    writer = points.writer(buffers)
    writer.write(len(next(iter(kept.values()))))
    writer.close()
    image.close()
    return path


def _cartesian(points: FloatArray) -> dict[str, FloatArray]:
    return dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T, strict=True))


def _spherical(folder: Path) -> str:
    local = points_of_wall() - points_of_wall().mean(axis=0) + [0.0, 40.0, 0.0]
    ranges = np.linalg.norm(local, axis=1)
    fields = {
        "sphericalRange": ranges,
        "sphericalAzimuth": np.arctan2(local[:, 1], local[:, 0]),
        "sphericalElevation": np.arcsin(local[:, 2] / ranges),
    }
    path = _e57(folder / "scan.e57", fields)
    return same_points(read_points(path).points, local)


def _no_invalid_state(folder: Path) -> str:
    points = points_of_wall()
    path = _e57(folder / "scan.e57", _cartesian(points))
    assert "cartesianInvalidState" not in pye57.E57(str(path)).get_header(0).point_fields
    return same_points(read_points(path).points, points)


def _pose_without_rotation(folder: Path) -> str:
    points = points_of_wall()
    station = points.mean(axis=0)
    path = _e57(folder / "scan.e57", _cartesian(points - station), {"translation": tuple(station)})
    (scan,) = read_placed_scans(path)
    assert scan.position is not None
    assert np.allclose(scan.position, station)
    return same_points(scan.cloud.points, points) + " by the pose's translation"


# --- text and PLY


def _rows(points: FloatArray, rest: str = "") -> str:
    return "".join(f"{x:.3f} {y:.3f} {z:.3f}{rest}\n" for x, y, z in points)


def _written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def _pts_without_count(folder: Path) -> str:
    points = points_of_wall()
    path = _written(folder / "scan.pts", _rows(points, " 0.4235 120 130 140"))
    return same_points(read_points(path).points, points)


def _pts_of_seven(folder: Path) -> str:
    points = points_of_wall()
    path = _written(folder / "scan.pts", f"{len(points)}\n{_rows(points, ' -1204 120 130 140')}")
    return same_points(read_points(path).points, points)


def _pts_with_one_more(folder: Path) -> str:
    points = points_of_wall()
    path = _written(folder / "scan.pts", f"{len(points) - 1}\n{_rows(points)}")
    return refused(lambda: read_points(path), folder, "599", "600")


def _ptx_without_a_matrix(folder: Path) -> str:
    points = points_of_wall(600)
    head = "30\n20\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 nan 0\n345200 5389450 120 1\n"
    path = _written(folder / "scan.ptx", head + _rows(points - points.mean(axis=0), " 0.5"))
    return refused(lambda: read_points(path), folder, "scan.ptx")


def _ply(path: Path, points: FloatArray, number: str, more: str = "", faces: bool = False) -> Path:
    """Write a binary PLY file of points; more: a list property of every vertex."""
    kind = {"float": "<f4", "double": "<f8"}[number]
    properties = "".join(f"property {number} {axis}\n" for axis in "xyz") + more
    end = "element face 0\nproperty list ushort int vertex_indices\n" if faces else ""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}{end}end_header\n"
    rows = [row.astype(kind).tobytes() + (struct.pack("<Bii", 2, 4, 9) if more else b"") for row in points]
    path.write_bytes(head.encode() + b"".join(rows))
    return path


def _ply_with_views(folder: Path) -> str:
    local = points_of_wall() - points_of_wall().mean(axis=0).round()
    path = _ply(folder / "scan.ply", local, "float", "property list uchar int view\n", faces=True)
    return same_points(read_ply_points(path).points, local)


def _ply_of_doubles(folder: Path) -> str:
    points = points_of_wall()
    return same_points(read_points(_ply(folder / "scan.ply", points, "double")).points, points)


def _ply_of_floats(folder: Path) -> str:
    """Northings in single precision: 0.5 m steps. The tracker's user saw lines of points."""
    _ply(folder / "scan.ply", points_of_wall(3000), "float")
    command = "surface scan.ply --seen-from 345210 5389400 125 --out wall.ply"
    return refused_by_command(command, folder, "single precision")


REPORTS = (
    Report("laspy/laspy#242", "a LAS file that ends before its last point", "refuse it, with both counts", _cut_las),
    Report("laspy/laspy#212", "a LAZ header that states more points than there are", "refuse it", _cut_laz),
    Report(
        "laspy/laspy#157",
        "undescribed bytes at the end of each record",
        "read the coordinates",
        _undeclared_bytes,
    ),
    Report(
        "PDAL/python#116", "point format 6 with GeoTIFF keys and the flag of WKT unset", "read the keys' unit", _flag_of_wkt_unset
    ),
    Report("PDAL/PDAL#1629", "return numbers and numbers of returns of 0", "read the points", _return_number_zero),
    Report("CloudCompare/CloudCompare#2104", "a LAS file of version 1.0", "read the points", _version_1_0),
    Report("360-geo/copc-converter#23", "LAS 1.4 whose counts for older readers are 0", "read the points", _no_older_count),
    Report("jblindsay/whitebox-tools#452", "points of the noise classes 7 and 18", "leave them out and say so", _noise_classes),
    Report("3dgeo-heidelberg/py4dgeo#118", "a LAS file given as text", "refuse it", _las_named_xyz),
    Report("davidcaron/pye57#18", "an E57 scan in spherical coordinates", "read the points", _spherical),
    Report("davidcaron/pye57#6", "an E57 scan without `cartesianInvalidState`", "read the points", _no_invalid_state),
    Report("davidcaron/pye57#58", "an E57 pose with a translation and no rotation", "place the points", _pose_without_rotation),
    Report("isl-org/Open3D#913", "a PTS file without its count, intensity a fraction", "read the points", _pts_without_count),
    Report("daavoo/pyntcloud#241", "a PTS file of seven columns, intensity below 0", "read the points", _pts_of_seven),
    Report("PDAL/PDAL#2317", "a PTS file with one point more than it states", "refuse it, with both counts", _pts_with_one_more),
    Report("Aurtechmx/openlidarviewer#314", "a PTX matrix that is no number", "refuse it", _ptx_without_a_matrix),
    Report("CloudCompare/CloudCompare#760", "PLY points with a list each, and 0 faces", "read the points", _ply_with_views),
    Report("gseg-ethz/F2S3_pc_deformation_monitoring#11", "PLY points in double precision", "read the points", _ply_of_doubles),
    Report("CloudCompare/CloudCompare#638", "PLY points in single precision, northings of 5,000 km", "refuse it", _ply_of_floats),
)
