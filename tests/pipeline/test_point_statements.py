"""What point files state about themselves, compared with their contents: units, counts, boxes, flags, poses, missing returns."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pye57
import pyproj
import pytest
import yaml
from gap_cases import write_scan
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct

from pipeline.api.measuring import measure
from pipeline.cli.main import main
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.formats.meshes.ply import write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.e57 import E57Scan, read_e57, write_e57
from pipeline.formats.points.fillers import without_fillers
from pipeline.formats.points.laz import read_laz, write_laz
from pipeline.formats.points.points import read_placed_scans, read_points
from pipeline.formats.points.ptx import read_ptx
from pipeline.formats.units import US_FOOT_M
from scene.common.errors import InputError

FT = 0.3048
COUNT = 500


@pytest.fixture
def points() -> np.ndarray[Any, Any]:
    return np.random.default_rng(3).uniform([600_000, 150_000, 400], [600_060, 150_040, 430], (COUNT, 3))


def las(path: Path, points: Any, change: Callable[[laspy.LasData], None] = lambda _: None, **header: Any) -> Path:
    """Write a LAS file with laspy."""
    head = laspy.LasHeader(**({"point_format": 6, "version": "1.4"} | header))
    head.scales, head.offsets = np.full(3, 1e-4 if np.ptp(points, axis=0).max() < 1e5 else 1e-3), np.floor(points.min(axis=0))
    data = laspy.LasData(head)
    data.x, data.y, data.z = points.T
    change(data)
    data.write(str(path))
    return path


def with_crs(*names: Any) -> Callable[[laspy.LasData], None]:
    """Return a function that adds a coordinate system as WKT; two names make a compound one."""
    crs = pyproj.CRS.from_user_input("+".join(names)) if isinstance(names[0], str) else names[0]
    return lambda data: data.header.add_crs(crs)


def with_keys(**keys: int) -> Callable[[laspy.LasData], None]:
    """Return a function that adds GeoTIFF keys by their numbers, such as k3072=2260."""

    def change(data: laspy.LasData) -> None:
        record = GeoKeyDirectoryVlr()
        record.geo_keys = [
            GeoKeyEntryStruct(id=int(name[1:]), tiff_tag_location=0, count=1, value_offset=value) for name, value in keys.items()
        ]
        record.geo_keys_header.number_of_keys = len(keys)
        data.header.vlrs.append(record)
        data.header.global_encoding.wkt = False

    return change


# --- LAS: the unit of the coordinate system


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("change", "factors"),
    [
        (with_crs("EPSG:2260"), (US_FOOT_M,) * 3),
        (with_crs("EPSG:2222"), (FT,) * 3),
        (with_crs("EPSG:2260+5703"), (US_FOOT_M, US_FOOT_M, 1.0)),
        (with_crs("EPSG:26910+8228"), (1.0, 1.0, FT)),
        (with_crs("EPSG:28356"), (1.0,) * 3),
        (with_crs(pyproj.CRS.from_wkt('LOCAL_CS["mine",UNIT["US survey foot",0.304800609601]]')), (US_FOOT_M,) * 3),
        (with_keys(k1024=1, k3072=2260), (US_FOOT_M,) * 3),
        (with_keys(k1024=1, k3072=32767, k3076=9002), (FT,) * 3),
        (with_keys(k1024=1, k3072=26910, k4099=9003), (1.0, 1.0, US_FOOT_M)),
        (with_keys(k1024=1, k3072=26910, k4096=8228), (1.0, 1.0, FT)),
    ],
)
def test_coordinates_come_in_metres_from_the_unit_that_las_states(
    tmp_path: Path, points: Any, change: Any, factors: tuple[float, ...], suffix: str
) -> None:
    """The factors are those of the definitions: 0.3048 m, and 1200 / 3937 m."""
    version = {} if "crs" in change.__qualname__ else {"point_format": 3, "version": "1.2"}
    path = las(tmp_path / f"a{suffix}", points, change, **version)
    found = read_points(path)
    np.testing.assert_allclose(found.points, points * factors, rtol=0, atol=0.6e-4)
    assert any("converted from" in note for note in found.notes) == (set(factors) != {1.0})


def test_a_unit_that_contradicts_the_file_is_an_error_that_names_both(tmp_path: Path, points: Any) -> None:
    path = las(tmp_path / "a.laz", points, with_crs("EPSG:2260"))
    with pytest.raises(InputError, match=r"us-ft \(US survey foot\).*New York East.*--unit says ft \(international foot\)"):
        read_placed_scans(path, unit="ft")
    (scan,) = read_placed_scans(path, unit="us-ft")
    np.testing.assert_allclose(scan.cloud.points, points * US_FOOT_M, rtol=0, atol=0.6e-4)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (with_crs("EPSG:4979"), "in degrees.*project the points"),
        (with_crs("EPSG:4978"), "from the Earth's centre.*project the points"),
        (with_keys(k1024=2, k2048=4326), r"in degrees.*\(geographic system 4326\)"),
        (with_keys(k1024=1, k3072=26910, k3076=9003), "two units of its coordinates.*1 m by the coordinate system, 0.3048006"),
    ],
)
def test_coordinates_that_are_no_lengths_are_refused(tmp_path: Path, points: Any, change: Any, problem: str) -> None:
    version = {} if "crs" in change.__qualname__ else {"point_format": 3, "version": "1.2"}
    with pytest.raises(InputError, match=problem):
        read_points(las(tmp_path / "a.las", points, change, **version))


def test_a_coordinate_system_that_is_not_understood_is_said(tmp_path: Path, points: Any) -> None:
    def of(text: str) -> Callable[[laspy.LasData], None]:
        return lambda data: data.header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(text))

    found = read_points(las(tmp_path / "a.las", points, of("our own grid")))
    assert any("not understood: 'our own grid'" in note for note in found.notes)
    with pytest.raises(InputError, match=r"not understood.*names the unit 'feet'"):
        read_points(las(tmp_path / "b.las", points, of("our own grid, feet")))


# --- LAS: counts, boxes, flags


def patched(path: Path, at: int, form: str, value: float) -> Path:
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, at, value)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("at", "form", "value", "problem"),
    [
        (131, "<d", 1e-3, "states a box from .* and its points lie from"),
        (155, "<d", 0.0, "states a box from .* and its points lie from"),
        (179, "<d", 600_050.0, "states a box from .* and its points lie from"),
        (247, "<Q", 400, "states 400 points, but the file has room for 500"),
        (247, "<Q", 600, "states 600 points, but the file has room for 500"),
        (107, "<I", 499, "states 500 points, but 499 in the field of older"),
    ],
)
def test_a_las_header_that_the_points_contradict_is_an_error(
    tmp_path: Path, points: Any, at: int, form: str, value: float, problem: str
) -> None:
    """The scale, the offset, the box or the count contradicts them."""
    path = patched(las(tmp_path / "a.las", points), at, form, value)
    with pytest.raises(InputError, match=problem) as caught:
        read_points(path)
    assert caught.value.remedy


def test_a_box_that_states_nothing_or_too_much(tmp_path: Path, points: Any) -> None:
    path = las(tmp_path / "a.las", points)
    whole = path.read_bytes()
    for at in range(179, 227, 8):
        patched(path, at, "<d", 0.0)
    assert not read_points(path).notes
    path.write_bytes(whole)
    patched(path, 179, "<d", 700_000.0)
    (note,) = read_points(path).notes
    assert "700000" in note
    assert "it is part of a larger file, or its scale is wrong" in note


def test_a_laz_file_with_another_count_than_its_chunks_is_an_error(tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", PointCloud(np.random.default_rng(1).uniform(0, 50, (120_000, 3))))
    patched(tmp_path / "a.laz", 247, "<Q", 90_000)
    with pytest.raises(InputError, match=r"not a complete LAS or LAZ file \(3 chunks for 90,000 points\)"):
        read_points(tmp_path / "a.laz")


def test_points_that_las_takes_out_of_use_are_left_out_with_a_word(tmp_path: Path, points: Any) -> None:
    flags, classes = np.zeros(COUNT, dtype=np.uint8), np.full(COUNT, 2, dtype=np.uint8)
    flags[:20], classes[30:40] = 1, 7

    def change(data: laspy.LasData) -> None:
        data.withheld, data.classification = flags, classes

    found = read_points(las(tmp_path / "a.laz", points, change))
    np.testing.assert_allclose(found.points, np.delete(points, [*range(20), *range(30, 40)], axis=0), atol=0.6e-4)
    assert found.notes == (
        "20 points flagged as withheld in the file are left out",
        "10 points classified as noise in the file are left out",
    )
    assert set(found.extra["classification"]) == {2}


def test_a_flag_that_all_points_have_takes_none_out(tmp_path: Path, points: Any) -> None:
    """For example, a program may flag all points of photographs as synthetic."""

    def change(data: laspy.LasData) -> None:
        data.synthetic = np.ones(COUNT, dtype=np.uint8)

    found = read_points(las(tmp_path / "a.laz", points, change))
    assert len(found.points) == COUNT
    assert found.notes == ("all points are flagged as synthetic and are kept",)


def test_a_box_in_single_precision_contradicts_nothing(tmp_path: Path, points: Any) -> None:
    """A northing of 6,389,450 m is then rounded to 0.5 m."""
    far = points + np.array([0, 6_239_450, 0])
    path = las(tmp_path / "a.las", far)
    for at, value in ((195, far[:, 1].max()), (203, far[:, 1].min())):
        patched(path, at, "<d", float(np.float32(value)))
    assert len(read_points(path).points) == COUNT


def test_a_file_that_is_no_las_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.laz").write_text("1 2 3\n" * 100)
    with pytest.raises(InputError, match=r"not a LAS or LAZ file: it begins with b'1 2 '.*suffix of its format"):
        read_points(tmp_path / "a.laz")


# --- records without a return


def cloud_with(points: Any, filler: Any, count: int) -> Any:
    """Return points (n, 3) among which `count` records at one place are spread."""
    rows = np.sort(np.random.default_rng(2).choice(len(points) + count, len(points), replace=False))
    found = np.tile(np.asarray(filler, dtype=float), (len(points) + count, 1))
    found[rows] = points
    return found


@pytest.mark.parametrize("suffix", [".e57", ".ptx", ".pts", ".xyz", ".csv", ".ply", ".las"])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (600_000.0, 150_000.0, 400.0)])
def test_records_at_the_origin_are_no_points(tmp_path: Path, suffix: str, offset: tuple[float, ...]) -> None:
    """For clouds around the scanner and in survey coordinates."""
    points = np.random.default_rng(5).uniform(-20, 20, (300, 3)).round(3) + offset
    both, path = cloud_with(points, (0, 0, 0), 40), tmp_path / f"a{suffix}"
    match suffix:
        case ".e57":
            write_e57(path, [E57Scan("one", PointCloud(both), np.zeros(3), np.eye(3))])
        case ".ptx":
            pose = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
            path.write_text(f"34\n10\n{pose}" + "".join(f"{x:.4f} {y:.4f} {z:.4f} 0.5\n" for x, y, z in both))
        case ".ply":
            write_ply_points(path, PointCloud(both))
        case ".las":
            las(path, both)
        case _:
            np.savetxt(path, both, fmt="%.4f", delimiter="," if suffix == ".csv" else " ")
    found = read_points(path)
    np.testing.assert_allclose(found.points, points, rtol=0, atol=0.6e-4)
    assert any(note.startswith(("40 records at 0 0 0", "40 of 340 cells without a return")) for note in found.notes)


def test_records_at_another_shared_place_are_no_points(points: Any) -> None:
    """For example the scanner's position, if records 0 0 0 were transformed to world coordinates with the rest."""
    found = without_fillers(PointCloud(cloud_with(points, (600_010.5, 150_020.0, 410.0), 30)), "a")
    np.testing.assert_array_equal(found.points, points)
    assert found.notes == ("30 records at 600010.5 150020 410, which stand for no return, are left out",)


def test_points_that_are_few_at_a_place_stay(points: Any) -> None:
    """One point at the origin among others, and points that a file contains three times each."""
    around = np.concatenate([points - points.mean(axis=0), np.zeros((1, 3))])
    assert without_fillers(PointCloud(around), "a").points is around
    thrice = np.repeat(points, 3, axis=0)
    assert without_fillers(PointCloud(thrice), "a").points is thrice
    assert len(without_fillers(PointCloud(np.concatenate([points, np.zeros((1, 3))])), "a").points) == COUNT
    with pytest.raises(InputError, match="all 9 records are 0 0 0"):
        without_fillers(PointCloud(np.zeros((9, 3))), "a")


# --- E57


def raw_e57(path: Path, metadata: str = "", **columns: Any) -> Path:
    """Write an E57 file with one scan of these fields, as other programs do."""
    lib = pye57.libe57
    image = lib.ImageFile(str(path), "w")
    image.extensionsAdd("", lib.E57_V1_0_URI)
    image.root().set("coordinateMetadata", lib.StringNode(image, metadata))
    data, node, prototype = lib.VectorNode(image, True), lib.StructureNode(image), lib.StructureNode(image)
    buffers, kept = lib.VectorSourceDestBuffer(), []
    for name, values in columns.items():
        whole = values.dtype.kind != "f"
        prototype.set(name, lib.IntegerNode(image, 0, 0, 255) if whole else lib.FloatNode(image, 0.0))
        kept.append(np.ascontiguousarray(values, dtype=np.int8 if whole else np.float64))
        buffers.append(lib.SourceDestBuffer(image, name, kept[-1], len(values), True, True))
    cells = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
    image.root().set("data3D", data)
    node.set("points", cells)
    data.append(node)
    writer = cells.writer(buffers)
    writer.write(len(values))
    writer.close()
    image.close()
    return path


@pytest.mark.parametrize("kind", ["cartesian", "spherical"])
@pytest.mark.parametrize("state", [1, 2])
def test_e57_records_that_are_marked_as_invalid_are_left_out(tmp_path: Path, kind: str, state: int) -> None:
    rng = np.random.default_rng(4)
    xyz = rng.uniform(2, 30, (100, 3))
    invalid = np.where(np.arange(100) % 4 == 0, state, 0)
    distance = np.linalg.norm(xyz, axis=1)
    angles = np.arctan2(xyz[:, 1], xyz[:, 0]), np.arcsin(xyz[:, 2] / distance)
    columns = {
        "cartesian": dict(zip(("cartesianX", "cartesianY", "cartesianZ"), xyz.T, strict=True)),
        "spherical": {"sphericalRange": distance, "sphericalAzimuth": angles[0], "sphericalElevation": angles[1]},
    }[kind]
    (scan,) = read_e57(raw_e57(tmp_path / "a.e57", **columns, **{f"{kind}InvalidState": invalid}))
    np.testing.assert_allclose(scan.cloud.points, xyz[invalid == 0], atol=1e-12)
    assert scan.cloud.notes == ("25 records that the file marks as invalid are left out",)


def test_e57_fields_that_are_not_read_are_named(tmp_path: Path) -> None:
    xyz = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), np.random.default_rng(1).uniform(1, 9, (3, 50)), strict=True))
    intensity = {"intensity": np.linspace(0.1, 1, 50), "isIntensityInvalid": (np.arange(50) < 5).astype(int)}
    (scan,) = read_e57(raw_e57(tmp_path / "a.e57", **xyz, **intensity, temperature=np.full(50, 20.0)))
    assert "fields that are not read: temperature" in scan.cloud.notes
    assert scan.cloud.intensity is not None
    np.testing.assert_array_equal(np.isnan(scan.cloud.intensity), np.arange(50) < 5)


def test_e57_in_another_unit_than_metres_is_refused(tmp_path: Path) -> None:
    """E57 prescribes metres; a coordinate system in feet contradicts it."""
    xyz = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), np.random.default_rng(1).uniform(1, 9, (3, 50)), strict=True))
    with pytest.raises(InputError, match=r"us-ft \(US survey foot\), but E57 files are in metres"):
        read_e57(raw_e57(tmp_path / "a.e57", pyproj.CRS.from_epsg(2260).to_wkt(), **xyz))
    assert len(read_e57(raw_e57(tmp_path / "b.e57", pyproj.CRS.from_epsg(28356).to_wkt(), **xyz))[0].cloud.points) == 50


def test_a_cut_e57_says_how_much_is_missing(tmp_path: Path, points: Any) -> None:
    path = tmp_path / "a.e57"
    write_e57(path, [E57Scan("one", PointCloud(points), np.zeros(3), np.eye(3))])
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[: size // 2])
    with pytest.raises(
        InputError, match=rf"its header states {size:,} bytes, but it has {size // 2:,}.*copy the complete file again, or export"
    ):
        read_e57(path)
    path.write_bytes(b"PK\3\4" * 100)
    with pytest.raises(InputError, match=r"it begins with b'PK.*suffix of its format"):
        read_e57(path)


# --- PTX


def ptx(
    path: Path, rows: str, size: tuple[int, int] = (2, 3), place: str = "0 0 0", matrix: str = "0 0 0", decimal: str = "."
) -> Path:
    pose = f"{place}\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n{matrix} 1\n"
    path.write_text(f"{size[0]}\n{size[1]}\n{pose}{rows}".replace(".", decimal))
    return path


CELLS = (
    "1.0 2.0 3.0 0.5 9 8 7\n0 0 0 0.5 0 0 0\n4.0 5.0 6.0 0.5 9 8 7\n0 0 0 0 0 0 0\n7.0 8.0 9.0 0.5 9 8 7\n1.5 2.5 3.5 0.5 9 8 7\n"
)


def test_ptx_keeps_colours_and_says_what_it_leaves_out(tmp_path: Path) -> None:
    for decimal in (".", ","):
        (scan,) = read_ptx(ptx(tmp_path / "a.ptx", CELLS, decimal=decimal))
        np.testing.assert_array_equal(scan.cloud.points, [[1, 2, 3], [4, 5, 6], [7, 8, 9], [1.5, 2.5, 3.5]])
        np.testing.assert_array_equal(scan.cloud.extra["red"], [9] * 4)
        assert scan.cloud.notes == ("2 of 6 cells without a return (0 0 0) are left out",)


def test_ptx_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = ptx(tmp_path / "a.ptx", CELLS)
    for encoding in ("utf-8-sig", "utf-16"):
        (tmp_path / "b.ptx").write_bytes(path.read_text().encode(encoding))
        assert len(read_points(tmp_path / "b.ptx").points) == 4


@pytest.mark.parametrize(
    ("how", "problem"),
    [
        ({"size": (2, 4)}, r"scan 1 states 2 x 4 = 8 cells but has 6 lines"),
        ({"size": (2, 2)}, r"line 15: the file has more lines than the grid of scan 1 has cells: '7.0 8.0"),
        (
            {"place": "10 20 5", "matrix": "10 20 7"},
            "two poses of the scanner: its position is 10 20 5 .* but 10 20 7",
        ),
        ({"rows": CELLS.replace("5.0", "five")}, r"line 13, column 2: 'five' is not a number"),
        ({"rows": "1.0 2.0 3.0\n" * 6}, "have 3 values; allowed: x y z intensity"),
    ],
)
def test_a_ptx_file_that_contradicts_itself_is_an_error(tmp_path: Path, how: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        read_ptx(ptx(tmp_path / "a.ptx", **({"rows": CELLS} | how)))
    assert caught.value.remedy


def test_a_second_ptx_scan_that_comes_too_early_is_named(tmp_path: Path) -> None:
    text = ptx(tmp_path / "a.ptx", CELLS).read_text()
    (tmp_path / "b.ptx").write_text(text.replace("2\n3\n", "2\n4\n", 1) + text)
    with pytest.raises(InputError, match="scan 1 states 8 cells but has 6 lines before the next scan begins"):
        read_ptx(tmp_path / "b.ptx")


# --- PLY


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_ply_file_with_more_points_than_it_states_is_an_error(tmp_path: Path, form: str) -> None:
    header = f"ply\nformat {form} 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    values = np.arange(15, dtype="<f4").reshape(5, 3)
    body = values.tobytes() if form != "ascii" else "".join(f"{x} {y} {z}\n" for x, y, z in values).encode()
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    unit, more = ("lines", "2") if form == "ascii" else ("records", "24 bytes of")
    with pytest.raises(InputError, match=f"3 vertex {unit} are stated, and {more} more follow"):
        read_points(tmp_path / "a.ply")


def test_a_comment_on_the_place_of_ply_points_is_said(tmp_path: Path) -> None:
    """What programs write into PLY comments is not applied, and a note says so.

    PLY has no field for a coordinate system or a shift.
    """
    header = "ply\nformat ascii 1.0\ncomment made by hand\ncomment offset 345200 6389400 0\nelement vertex 2\n"
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(f"{header}{axes}end_header\n1 2 3\n4 5 7\n")
    assert read_points(tmp_path / "a.ply").notes == ("its header has 'offset 345200 6389400 0', which is not applied",)


# --- every reader


def test_every_reader_uses_the_unit_and_leaves_fillers_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`read_measurement` (gap, calibrate, compare --measured), Python's `measure`, and `surface` read US feet alike."""
    case = tmp_path / "case"
    case.mkdir()
    write_scan(case, 1, step_rad=0.012)
    stated = yaml.safe_load((case / "measurement.yaml").read_text())
    plain = read_measurement(case)
    cloud = read_points(case / stated["points"])
    where = cloud.points @ np.array(stated["scanner"]["rotation"]).T + stated["scanner"]["position_m"]
    in_feet = cloud_with(where / US_FOOT_M, (0, 0, 0), 50)
    las(case / "feet.las", in_feet, with_crs("EPSG:2260"))
    (case / "measurement.yaml").write_text(yaml.safe_dump(stated | {"points": "feet.las", "frame": "world"}))
    found = read_measurement(case)
    np.testing.assert_allclose(found.cloud.points, plain.cloud.points, atol=1e-4)
    assert sum("feet.las" in note for note in found.notes) == 2
    again = measure(sensor="tls", reference=case / stated["reference"], points=case / "feet.las",
                    model=case / stated["model"], scanner=stated["scanner"])  # fmt: skip
    np.testing.assert_allclose(again.held.cloud.points, plain.cloud.points, atol=1e-4)
    place = [str(value) for value in stated["scanner"]["position_m"]]
    main(["surface", str(case / "feet.las"), "--seen-from", *place, "--out", str(tmp_path / "w.ply")])
    told = capsys.readouterr().out
    assert "50 records at 0 0 0" in told
    assert "converted from us-ft" in told


def test_laz_of_ours_states_its_system_and_is_read_as_it_was(tmp_path: Path, points: Any) -> None:
    write_laz(tmp_path / "a.laz", PointCloud(points))
    assert read_laz(tmp_path / "a.laz").notes == ()
