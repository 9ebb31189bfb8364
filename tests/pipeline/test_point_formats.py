"""Point clouds in every format that a measurement may have; `test_formats` tests LAZ and PLY as the run writes them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pye57
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.bad_inputs.raw_cases import in_e57
from pipeline.formats.meshes.ply import read_ply_points, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.e57 import E57Scan, read_e57, write_e57
from pipeline.formats.points.laz import PulseChannels, read_laz, write_laz
from pipeline.formats.points.points import SUFFIXES, read_points
from pipeline.formats.points.xyz import read_xyz, write_xyz
from pipeline.measurement.scans import read_scans
from scene.common.errors import InputError

UTM = np.array([331_245.0, 6_270_118.0, 412.0])
ROTATION = Rotation.from_rotvec([0.1, -0.4, 2.0]).as_matrix()
COUNT = 5_000


@pytest.fixture
def cloud() -> PointCloud:
    rng = np.random.default_rng(1)
    return PointCloud(
        points=rng.uniform(-80, 80, (COUNT, 3)),
        intensity=rng.uniform(0, 1, COUNT).astype(np.float32),
        gps_time=np.arange(COUNT) * 1e-5 + 0.1,
        extra={"row": np.arange(COUNT, dtype=np.int32) // 100, "column": np.arange(COUNT, dtype=np.int32) % 100},
    )


def scan(cloud: PointCloud, name: str = "station 1", position: Any = UTM) -> E57Scan:
    return E57Scan(name, cloud, np.asarray(position, dtype=float), ROTATION)


def assert_same(read: PointCloud, written: PointCloud, atol: float = 0.0) -> None:
    np.testing.assert_allclose(read.points, written.points, rtol=0, atol=atol)
    np.testing.assert_array_equal(read.intensity, written.intensity)
    np.testing.assert_array_equal(read.gps_time, written.gps_time)
    assert set(read.extra) == set(written.extra)
    for name, channel in written.extra.items():
        np.testing.assert_array_equal(read.extra[name], channel)


# --- E57


def test_e57_gives_back_points_grid_and_pose(tmp_path: Path, cloud: PointCloud) -> None:
    write_e57(tmp_path / "a.e57", [scan(cloud)])
    (back,) = read_e57(tmp_path / "a.e57")
    assert_same(back.cloud, cloud)
    assert back.name == "station 1"
    np.testing.assert_array_equal(back.position, UTM)
    np.testing.assert_allclose(back.rotation, ROTATION, atol=1e-15)


def test_e57_is_read_by_the_library_s_own_reader(tmp_path: Path, cloud: PointCloud) -> None:
    write_e57(tmp_path / "a.e57", [scan(cloud)])
    data = pye57.E57(str(tmp_path / "a.e57")).read_scan(0, intensity=True, row_column=True, ignore_missing_fields=True)
    points = np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(points, cloud.points @ ROTATION.T + UTM, rtol=0, atol=1e-8)  # UTM in double: 1e-9
    np.testing.assert_array_equal(data["intensity"], cloud.intensity)
    np.testing.assert_array_equal(data["rowIndex"], cloud.extra["row"])
    np.testing.assert_array_equal(data["columnIndex"], cloud.extra["column"])


def test_e57_of_another_writer_is_read_without_its_invalid_points(tmp_path: Path, cloud: PointCloud) -> None:
    """pye57's own writer stores float32: 4 um at 80 m."""
    invalid = (np.arange(COUNT) % 7 == 0).astype(np.int8)
    fields = {f"cartesian{axis}": cloud.points[:, index] for index, axis in enumerate("XYZ")}
    quaternion = Rotation.from_matrix(ROTATION).as_quat(scalar_first=True)
    with pye57.E57(str(tmp_path / "a.e57"), "w") as file:
        file.write_scan_raw({**fields, "cartesianInvalidState": invalid}, rotation=quaternion, translation=UTM)
    (back,) = read_e57(tmp_path / "a.e57")
    np.testing.assert_allclose(back.cloud.points, cloud.points[invalid == 0], rtol=0, atol=4e-6)
    np.testing.assert_allclose(back.rotation, ROTATION, atol=1e-15)
    assert back.cloud.intensity is None


def test_e57_spherical_scans_are_read(tmp_path: Path) -> None:
    """Elevation is above the horizon: (range 2, azimuth 0, elevation 30 deg) lies at z = +1."""
    libe57 = pye57.libe57
    image = libe57.ImageFile(str(tmp_path / "a.e57"), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    data, node, prototype = libe57.VectorNode(image, True), libe57.StructureNode(image), libe57.StructureNode(image)
    values = np.array([[2.0, 3.0], [0.0, np.pi / 2], [np.pi / 6, 0.0]])
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in zip(("sphericalRange", "sphericalAzimuth", "sphericalElevation"), values, strict=True):
        prototype.set(name, libe57.FloatNode(image, 0.0))
        buffers.append(libe57.SourceDestBuffer(image, name, column, 2, True, True))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    image.root().set("data3D", data)
    node.set("points", points)
    data.append(node)
    writer = points.writer(buffers)
    writer.write(2)
    writer.close()
    image.close()
    (back,) = read_e57(tmp_path / "a.e57")
    np.testing.assert_allclose(back.cloud.points, [[np.sqrt(3), 0, 1], [0, 3, 0]], atol=1e-15)
    np.testing.assert_array_equal(back.rotation, np.eye(3))


def test_e57_is_the_same_bytes_again(tmp_path: Path, cloud: PointCloud) -> None:
    for name in ("a", "b"):
        write_e57(tmp_path / f"{name}.e57", [scan(cloud)])
    assert (tmp_path / "a.e57").read_bytes() == (tmp_path / "b.e57").read_bytes()


@pytest.mark.parametrize("keep", [0.5, 0.02, 0.0])
def test_a_damaged_e57_is_named(tmp_path: Path, cloud: PointCloud, keep: float) -> None:
    path = tmp_path / "a.e57"
    write_e57(path, [scan(cloud)])
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * keep)])
    with pytest.raises(InputError, match=r"a\.e57: the file is not a complete E57 file"):
        read_e57(path)


def test_an_e57_takes_memory_for_the_points_that_are_there(tmp_path: Path, cloud: PointCloud) -> None:
    """The header claims a billion points; read in parts of a thousand, the points are the same as at once."""
    path, claim = tmp_path / "a.e57", 'recordCount="5000">\n        '
    write_e57(path, [scan(cloud)])
    (at_once,) = read_e57(path)
    monkeypatch = pytest.MonkeyPatch()
    with monkeypatch.context() as patched:
        patched.setattr("pipeline.formats.points.e57._PIECE", 1000)
        assert_same(read_e57(path)[0].cloud, at_once.cloud)
    in_e57(path, claim, 'recordCount="999999999">')
    with pytest.raises(InputError, match="5,000 points but states 999,999,999"):
        read_e57(path)


@pytest.mark.parametrize("suffix", [".ptx", ".e57", ".laz", ".ply", ".xyz"])
def test_a_pipe_in_the_place_of_a_scan_is_not_opened(tmp_path: Path, suffix: str) -> None:
    os.mkfifo(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match="is a pipe"):
        read_scans(tmp_path / f"a{suffix}")


# --- LAS 1.4: returns and scan angle


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_returns_and_scan_angles_are_standard_las_fields(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    rng = np.random.default_rng(2)
    count = rng.integers(1, 16, COUNT)
    number = rng.integers(1, count + 1)
    zenith = rng.uniform(0, np.pi, COUNT)
    path = tmp_path / f"a{suffix}"
    write_laz(path, PointCloud(cloud.points), PulseChannels(number, count, np.pi - zenith))
    las = laspy.read(path)
    np.testing.assert_array_equal(las.return_number, number)
    np.testing.assert_array_equal(las.number_of_returns, count)
    np.testing.assert_allclose(np.asarray(las.scan_angle) * 0.006, 180 - np.degrees(zenith), atol=0.003001)
    back = read_laz(path)
    np.testing.assert_array_equal(back.extra["return_number"], number)
    np.testing.assert_array_equal(back.extra["number_of_returns"], count)
    np.testing.assert_allclose(back.extra["scan_angle_rad"], np.pi - zenith, atol=np.radians(0.003001))


def test_single_returns_are_one_of_one_and_no_channel(tmp_path: Path, cloud: PointCloud) -> None:
    write_laz(tmp_path / "a.laz", PointCloud(cloud.points))
    las = laspy.read(tmp_path / "a.laz")
    assert set(np.unique(las.return_number)) == set(np.unique(las.number_of_returns)) == {1}
    assert read_laz(tmp_path / "a.laz").extra == {}


def test_scan_angles_of_old_point_formats_are_degrees(tmp_path: Path) -> None:
    las = laspy.create(point_format=1, file_version="1.2")
    las.x, las.y, las.z = np.zeros(3), np.zeros(3), np.zeros(3)
    las.scan_angle_rank = np.array([-45, 0, 90], dtype=np.int8)
    las.write(tmp_path / "old.las")
    np.testing.assert_allclose(read_laz(tmp_path / "old.las").extra["scan_angle_rad"], np.radians([-45, 0, 90]))


@pytest.mark.parametrize(("number", "count"), [(0, 1), (2, 1), (16, 16)])
def test_impossible_returns_are_refused(tmp_path: Path, number: int, count: int) -> None:
    with pytest.raises(ValueError, match="return numbers"):
        write_laz(tmp_path / "a.laz", PointCloud(np.zeros((1, 3))), PulseChannels(np.array([number]), np.array([count])))
    assert not list(tmp_path.iterdir())


# --- XYZ


def test_xyz_gives_back_every_channel(tmp_path: Path, cloud: PointCloud) -> None:
    write_xyz(tmp_path / "a.xyz", cloud)
    back = read_xyz(tmp_path / "a.xyz")
    assert (tmp_path / "a.xyz").read_text().startswith("//x y z intensity gps_time row column\n")
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=0.51e-6)
    assert_same(replace(back, points=cloud.points, intensity=np.float32(back.intensity)), cloud)


def test_xyz_is_read_by_open3d(tmp_path: Path, cloud: PointCloud) -> None:
    import open3d as o3d

    write_xyz(tmp_path / "a.xyz", PointCloud(cloud.points))
    path = tmp_path / "bare.xyz"
    path.write_text((tmp_path / "a.xyz").read_text().split("\n", 1)[1])
    np.testing.assert_allclose(np.asarray(o3d.io.read_point_cloud(str(path)).points), cloud.points, rtol=0, atol=0.51e-6)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("1 2 3\n4 5 6\n", []),
        ("1 2 3 7\r\n4 5 6 8\r\n", ["intensity"]),
        ("1,2,3,7\n4,5,6,8\n", ["intensity"]),
        ("1; 2; 3; 7; 9\n4; 5; 6; 8; 9\n", ["column_4", "column_5"]),
        ("2\n1 2 3\n4 5 6\n", []),
        ("# a scan\n# X Y Z Intensity\n1 2 3 7\n4 5 6 8\n", ["intensity"]),
        ("//x,y,z,pixel_x,pixel_y\n1,2,3,7,9\n4,5,6,8,9\n", ["pixel_x", "pixel_y"]),
        ("intensity z y x\n7 3 2 1\n8 6 5 4\n", ["intensity"]),
        ("1\t2\t3\t7\n4e0\t5\t6\t8", ["intensity"]),
    ],
)
def test_xyz_layouts(tmp_path: Path, text: str, names: list[str]) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(text.encode())
    back = read_xyz(path)
    np.testing.assert_array_equal(back.points, [[1, 2, 3], [4, 5, 6]])
    assert [*(["intensity"] if back.intensity is not None else []), *back.extra] == names
    if names == ["intensity"]:
        np.testing.assert_array_equal(back.intensity, [7, 8])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no line of numbers"),
        ("1 2\n3 4\n", "no line of numbers"),
        ("1 2 3\n4 five 6\n", "line 2, column 2: 'five' is not a number"),
        ("1 2 3\n4 5\n", "line 2: the number of values in this line is 2"),
        ("a rock wall\n", "no line of numbers"),
    ],
)
def test_xyz_that_is_none_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_xyz(tmp_path / "a.xyz")
    assert "\n" not in str(caught.value)


# --- any format


def test_a_cloud_is_read_by_its_suffix(tmp_path: Path, cloud: PointCloud) -> None:
    """In scanner coordinates, except E57, whose pose is applied."""
    write_laz(tmp_path / "a.laz", PointCloud(cloud.points))
    write_laz(tmp_path / "a.LAS", PointCloud(cloud.points))
    write_ply_points(tmp_path / "a.ply", cloud)
    write_xyz(tmp_path / "a.xyz", cloud)
    write_e57(tmp_path / "a.e57", [scan(cloud)])
    for path in tmp_path.iterdir():
        expected = cloud.points @ ROTATION.T + UTM if path.suffix == ".e57" else cloud.points
        np.testing.assert_allclose(read_points(path).points, expected, rtol=0, atol=0.51e-6)


def test_scans_of_one_e57_become_one_cloud(tmp_path: Path, cloud: PointCloud) -> None:
    timeless = replace(cloud, points=cloud.points[:10], intensity=cloud.intensity[:10], gps_time=None, extra={})
    write_e57(tmp_path / "a.e57", [scan(cloud), scan(timeless, "station 2", UTM + 30)])
    both = read_points(tmp_path / "a.e57")
    assert len(both.points) == COUNT + 10
    np.testing.assert_allclose(both.points[-10:] - both.points[:10], 30.0, atol=1e-8)
    np.testing.assert_array_equal(both.extra["scan"], [0] * COUNT + [1] * 10)
    assert both.gps_time is None
    assert set(both.extra) == {"scan"}


def test_other_suffixes_are_refused_with_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(b"VERSION .7")
    with pytest.raises(InputError, match=r"unknown format '\.pcd'") as caught:
        read_points(tmp_path / "a.pcd")
    assert all(suffix in str(caught.value) for suffix in SUFFIXES)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_missing_file_is_named(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match=f"nowhere{suffix}: "):
        read_points(tmp_path / f"nowhere{suffix}")


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (np.array([-5, 7, 2**31 - 1]), np.int32),
        (np.array([0, 3, 2**32 - 1], dtype=np.uint64), np.uint32),
        (np.array([0, 3, 2**52 + 1]), np.float64),
        (np.array([True, False, True]), np.uint8),
        (np.array([0.5, np.nan, -2.0], dtype=np.float16), np.float32),
    ],
)
def test_ply_stores_other_types_without_loss(tmp_path: Path, values: Any, kind: Any) -> None:
    write_ply_points(tmp_path / "a.ply", PointCloud(np.zeros((3, 3)), extra={"label": values}))
    found = read_ply_points(tmp_path / "a.ply").extra["label"]
    assert found.dtype == kind
    np.testing.assert_array_equal(found.astype(values.dtype), values)


def test_a_number_that_no_type_of_ply_holds_is_an_error(tmp_path: Path) -> None:
    labels = np.array([2**62 + 1, 0])
    with pytest.raises(InputError, match=r"a.ply: label: .*int64"):
        write_ply_points(tmp_path / "a.ply", PointCloud(np.zeros((2, 3)), extra={"label": labels}))
    assert not list(tmp_path.iterdir())
