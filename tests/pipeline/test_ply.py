"""PLY meshes and points: what is read back is what was written, other programs read it too, damaged files are reported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from format_cases import UTM, a_cloud, a_mesh

from pipeline.formats.meshes.ply import read_ply, read_ply_points, write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh
from scene.meshes.ply import read_elements


@pytest.fixture
def cloud() -> PointCloud:
    return a_cloud()


@pytest.fixture
def mesh() -> TriangleMesh:
    return a_mesh()


def test_ply_mesh_round_trip_is_exact(tmp_path: Path, mesh: TriangleMesh) -> None:
    for written in (mesh, TriangleMesh(mesh.vertices, mesh.faces), TriangleMesh(mesh.vertices, np.empty((0, 3), dtype=np.int32))):
        write_ply(tmp_path / "a.ply", written)
        read = read_ply(tmp_path / "a.ply")
        for name in ("vertices", "faces", "vertex_albedo", "vertex_block", "face_block"):
            before, after = getattr(written, name), getattr(read, name)
            assert (before is None) == (after is None), name
            if before is not None:
                assert after.dtype == before.dtype
                np.testing.assert_array_equal(after, before)


def test_ply_mesh_in_trimesh_and_open3d(tmp_path: Path, mesh: TriangleMesh) -> None:
    import open3d  # takes a second

    path = tmp_path / "a.ply"
    write_ply(path, mesh)
    theirs = trimesh.load(path, process=False)
    np.testing.assert_array_equal(theirs.vertices, mesh.vertices)
    np.testing.assert_array_equal(theirs.faces, mesh.faces)
    read = open3d.io.read_triangle_mesh(str(path))
    np.testing.assert_array_equal(np.asarray(read.vertices), mesh.vertices)
    np.testing.assert_array_equal(np.asarray(read.triangles), mesh.faces)


def test_ply_of_trimesh_and_open3d(tmp_path: Path, mesh: TriangleMesh) -> None:
    """Their float32 resolves UTM coordinates only to 0.25 m, so local coordinates are compared."""
    import open3d

    local = mesh.vertices - UTM
    for encoding in ("ascii", "binary_little_endian"):
        data = trimesh.Trimesh(local, mesh.faces, process=False).export(file_type="ply", encoding=encoding.split("_")[0])
        (tmp_path / "a.ply").write_bytes(data)
        read = read_ply(tmp_path / "a.ply")
        np.testing.assert_allclose(read.vertices, local, rtol=0, atol=1e-5)
        np.testing.assert_array_equal(read.faces, mesh.faces)
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(mesh.vertices))
    open3d.io.write_point_cloud(str(tmp_path / "b.ply"), points)
    np.testing.assert_array_equal(read_ply_points(tmp_path / "b.ply").points, mesh.vertices)


def test_ply_points_round_trip_is_exact(tmp_path: Path, cloud: PointCloud) -> None:
    write_ply_points(tmp_path / "a.ply", cloud)
    read = read_ply_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.points, cloud.points)
    np.testing.assert_array_equal(read.intensity, cloud.intensity)
    np.testing.assert_array_equal(read.gps_time, cloud.gps_time)
    assert list(read.extra) == list(cloud.extra)
    for name, channel in cloud.extra.items():
        np.testing.assert_array_equal(read.extra[name], channel)


def test_ply_points_have_the_names_that_cloudcompare_loads(tmp_path: Path, cloud: PointCloud) -> None:
    write_ply_points(tmp_path / "a.ply", cloud)
    names = list(read_elements(tmp_path / "a.ply")["vertex"])
    assert names == ["x", "y", "z", "intensity", "scalar_gps_time", *(f"scalar_{name}" for name in cloud.extra)]


def test_fields_of_cloudcompare_are_channels(tmp_path: Path) -> None:
    fields = ("Intensity", "GpsTime", "Original_cloud_index")
    header = "".join(f"property float {name}\n" for name in ("x", "y", "z", *(f"scalar_{field}" for field in fields)))
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{header}end_header\n1 2 3 0.5 7 2\n")
    read = read_ply_points(tmp_path / "a.ply")
    assert (read.intensity, read.gps_time) == (0.5, 7.0)
    assert list(read.extra) == ["Original_cloud_index"]


def test_a_field_and_a_property_of_one_name_stay_two(tmp_path: Path) -> None:
    header = "".join(f"property float {name}\n" for name in ("x", "y", "z", "block", "scalar_block", "scalar_x"))
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{header}end_header\n1 2 3 4 5 6\n")
    read = read_ply_points(tmp_path / "a.ply")
    assert {name: channel.item() for name, channel in read.extra.items()} == {"block": 4, "scalar_block": 5, "scalar_x": 6}


PROPERTIES = "property double x\nproperty double y\nproperty double z\nproperty uchar class\nproperty float intensity\n"


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_points_in_every_byte_order(tmp_path: Path, order: str) -> None:
    rows = [(1.5, 2.25, -3.0, 7, 0.5), (331245.123456, 6270118.654321, 4.0, 255, 1e-3)]
    header = f"ply\r\nformat {order} 1.0\ncomment made by hand\nelement vertex 2\n{PROPERTIES}end_header\n"
    kind = ">" if order.endswith("big_endian") else "<"
    packed = np.array(
        rows, dtype=[(name, kind + code) for name, code in zip("xyzci", ("f8", "f8", "f8", "u1", "f4"), strict=True)]
    )
    text = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    (tmp_path / "a.ply").write_bytes(header.encode() + (text if order == "ascii" else packed.tobytes()))
    read = read_ply_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.points, [row[:3] for row in rows])
    np.testing.assert_array_equal(read.extra["class"], [7, 255])
    np.testing.assert_array_equal(read.intensity, np.array([0.5, 1e-3], dtype=np.float32))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "does not begin with 'ply'"),
        (b"solid cube\n", "does not begin with 'ply'"),
        (b"ply\nformat ascii 1.0\n", "header has no end"),
        (b"ply\n" + b"a" * 100_000, "header has no end"),
        (b"ply\nformat ascii 9.0\nend_header\n", "format ascii 9.0"),
        (b"ply\nelement vertex 1\nend_header\n", "names no format"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "many"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "negative count"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty word x\nend_header\n", "word"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "not a whole PLY"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\nend_header\nabcd",
            "4 bytes are left",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n",
            "1 of 2",
        ),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n", "without z"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\none\n",
            "line 1, column 1: .*.one. is not a number",
        ),
        (b"ply\nformat ascii 1.0\nend_header\n", "no vertices"),
    ],
)
def test_ply_garbage_is_an_input_error(tmp_path: Path, data: bytes, words: str) -> None:
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_ply_points(tmp_path / "a.ply")


def test_ply_truncated_or_unfit_meshes_are_input_errors(tmp_path: Path, mesh: TriangleMesh) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, mesh)
    data = path.read_bytes()
    for size in (len(data) - 1, len(data) // 2, 400, 100):
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match="not a whole PLY"):
            read_ply(path)
    write_ply(path, TriangleMesh(mesh.vertices[:100], mesh.faces))
    with pytest.raises(InputError, match="beyond the 100"):
        read_ply(path)
    write_ply_points(path, PointCloud(mesh.vertices))
    with pytest.raises(InputError, match="only points"):
        read_ply(path)
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n"
    for faces in ("4 0 0 0 0\n4 0 0 0 0\n", "3 0 0 0\n4 0 0 0 0\n"):
        path.write_text(f"{head}property list uchar int vertex_indices\nend_header\n0 0 0\n{faces}")
        with pytest.raises(InputError):
            read_ply(path)
