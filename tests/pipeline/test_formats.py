"""Files: what is read back is what was written, other programs read it too, and nothing half-written is left."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import numpy as np
import open3d
import pytest
import rasterio
import tifffile
import trimesh

from pipeline.formats.atomic import write_bytes, write_json, write_text, writing
from pipeline.formats.geotiff import read_geotiff, read_tiff, write_geotiff, write_tiff
from pipeline.formats.laz import EXACT_INTENSITY, read_laz, write_laz
from pipeline.formats.ply import read_ply, read_ply_points, write_ply, write_ply_points
from pipeline.formats.point_cloud import PointCloud
from scene.errors import InputError
from scene.grid import Grid
from scene.mesh import TriangleMesh

UTM = np.array([331_245.0, 6_270_118.0, 412.0])
GRID = Grid(x_min=1.25, y_max=9.5, gsd=0.02, width=70, height=40)


@pytest.fixture
def cloud() -> PointCloud:
    rng = np.random.default_rng(1)
    count = 120_000  # more than two chunks of LAZ
    return PointCloud(
        points=rng.uniform([0, 0, -3], [70, 45, 3], (count, 3)),
        intensity=rng.lognormal(0, 2, count).astype(np.float32),
        gps_time=np.arange(count) * 1e-5 + 0.1,
        extra={
            "true_range_m": rng.uniform(90, 110, count),
            "cos_incidence": rng.uniform(0, 1, count).astype(np.float32),
            "block": rng.integers(0, 1500, count).astype(np.int32),
        },
    )


@pytest.fixture
def mesh() -> TriangleMesh:
    """A bumpy sheet of 50 x 30 vertices in UTM-sized coordinates, with all that a mesh can carry."""
    rng = np.random.default_rng(2)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(50.0), np.arange(30.0)))
    first = (np.arange(29)[:, None] * 50 + np.arange(49)).ravel()
    lower, upper = np.stack([first, first + 1, first + 50], axis=1), np.stack([first + 1, first + 51, first + 50], axis=1)
    return TriangleMesh(
        vertices=UTM + np.stack([x, y, rng.normal(size=x.size)], axis=1),
        faces=np.concatenate([lower, upper]).astype(np.int32),
        vertex_albedo=rng.uniform(0, 1, x.size).astype(np.float32),
        vertex_block=rng.integers(0, 9, x.size).astype(np.int32),
        face_block=rng.integers(0, 9, 2 * first.size).astype(np.int32),
    )


@pytest.fixture
def raster() -> np.ndarray:
    raster = np.random.default_rng(3).normal(0, 0.01, GRID.shape).astype(np.float32)
    raster[:5, 10:20] = np.nan
    return raster


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes: writing fails as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# --- whole or not at all


def test_failure_leaves_the_old_file_and_no_temporary(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "a.txt"
    write_text(path, "old")
    with pytest.raises(RuntimeError, match="stop"):
        _fail_half_way(path)
    assert path.read_text() == "old"
    assert list(path.parent.iterdir()) == [path]


def _fail_half_way(path: Path) -> None:
    with writing(path) as temporary:
        temporary.write_text("half")
        assert temporary.suffix == path.suffix
        raise RuntimeError("stop")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_killed_in_the_middle_leaves_no_file(tmp_path: Path, number: signal.Signals) -> None:
    code = (
        "import sys, time; from pathlib import Path; from pipeline.formats.atomic import writing\n"
        "with writing(Path(sys.argv[1])) as t:\n t.write_bytes(b'half'); print('ready', flush=True); time.sleep(60)"
    )
    path = tmp_path / "a.bin"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # jobs in the background of a shell ignore it
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    process.send_signal(number)
    process.communicate()
    assert not path.exists()
    if number == signal.SIGINT:
        assert list(tmp_path.iterdir()) == []
    write_bytes(path, b"whole")  # what a kill left is overwritten
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EDQUOT, "quota"),
        (errno.EACCES, "may not be written"),
        (errno.EROFS, "Read-only"),
    ],
)
def test_system_errors_become_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, words: str) -> None:
    def fail(*_: object) -> int:
        raise OSError(code, os.strerror(code))

    path = tmp_path / "a.json"
    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(InputError, match=words) as caught:
        write_json(path, [1])
    assert str(path) in str(caught.value)
    assert "--out" in caught.value.remedy
    assert list(tmp_path.iterdir()) == []


def test_paths_that_cannot_be_files(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "a.txt", tmp_path / "folder"):
        with pytest.raises(InputError, match="cannot be a file"):
            write_text(path, "a")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("size", [10, 3000, 200_000])
def test_full_disk_in_every_format(tmp_path: Path, cloud: PointCloud, mesh: TriangleMesh, size: int) -> None:
    big = np.zeros((300, 300), dtype=np.float32)
    faces = np.tile(mesh.faces, (20, 1))
    writers: list[Callable[[], None]] = [
        lambda: write_laz(tmp_path / "a.laz", cloud.points),
        lambda: write_laz(tmp_path / "a.las", cloud.points),
        lambda: write_ply(tmp_path / "a.ply", TriangleMesh(mesh.vertices, faces)),
        lambda: write_ply_points(tmp_path / "b.ply", cloud),
        lambda: write_tiff(tmp_path / "a.tif", big),
        lambda: write_geotiff(tmp_path / "b.tif", big, Grid(0, 6, 0.02, 300, 300)),
    ]
    for write in writers:
        with file_size_limit(size), pytest.raises(InputError, match=r"are free; make room"):
            write()
        assert list(tmp_path.iterdir()) == []
        write()
        for path in tmp_path.iterdir():
            path.unlink()


def test_json_holds_numpy_values_and_refuses_nan(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"b": np.float64(0.5), "a": np.arange(3), "c": np.int32(7), "d": np.bool_(True), "e": Path("x/y")})
    assert json.loads(path.read_text()) == {"b": 0.5, "a": [0, 1, 2], "c": 7, "d": True, "e": "x/y"}
    assert path.read_text().index('"b"') < path.read_text().index('"a"')
    with pytest.raises(ValueError, match="Out of range"):
        write_json(path, {"a": float("nan")})
    with pytest.raises(TypeError, match="no JSON form"):
        write_json(path, {"a": object()})
    assert json.loads(path.read_text())["c"] == 7


# --- LAZ


@pytest.mark.parametrize("suffix", [".laz", ".las"])
def test_laz_round_trip(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_laz(path, cloud.points, intensity=cloud.intensity, gps_time=cloud.gps_time, extra=cloud.extra)
    read = read_laz(path)
    np.testing.assert_allclose(read.points, cloud.points, rtol=0, atol=0.51e-6)  # half a step of the scale
    assert cloud.intensity is not None
    assert read.intensity is not None
    full_scale = 2 ** np.ceil(np.log2(cloud.intensity.max()))
    np.testing.assert_allclose(read.intensity, cloud.intensity, rtol=1e-6, atol=0.501 * full_scale / 65535)
    np.testing.assert_array_equal(read.gps_time, cloud.gps_time)
    assert list(read.extra) == list(cloud.extra)
    for name, channel in cloud.extra.items():
        assert read.extra[name].dtype == channel.dtype
        np.testing.assert_array_equal(read.extra[name], channel)


def test_laz_header_as_laspy_reads_it(tmp_path: Path, cloud: PointCloud) -> None:
    write_laz(tmp_path / "a.laz", cloud.points)
    with laspy.open(tmp_path / "a.laz") as reader:
        header = reader.header
    assert (str(header.version), header.point_format.id, header.point_count) == ("1.4", 6, len(cloud.points))
    assert header.generating_software == "scarpsim"
    assert header.global_encoding.wkt
    assert header.number_of_points_by_return[0] == len(cloud.points)
    np.testing.assert_allclose(header.mins, cloud.points.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(header.maxs, cloud.points.max(axis=0), atol=1e-6)


@pytest.mark.parametrize(("extent_m", "step_m"), [(70.0, 1e-6), (5000.0, 1e-5), (1e6, 1e-3)])
def test_laz_keeps_large_coordinates(tmp_path: Path, extent_m: float, step_m: float) -> None:
    points = UTM + np.random.default_rng(4).uniform(-0.5, 0.5, (1000, 3)) * extent_m
    points[:2] = UTM - extent_m / 2, UTM + extent_m / 2
    write_laz(tmp_path / "a.laz", points)
    np.testing.assert_allclose(read_laz(tmp_path / "a.laz").points, points, rtol=0, atol=0.51 * step_m)


def test_laz_bytes_do_not_depend_on_threads(tmp_path: Path) -> None:
    code = (
        "import sys, numpy as np; from pathlib import Path; from pipeline.formats.laz import write_laz\n"
        "p = np.random.default_rng(0).uniform(0, 70, (160_000, 3))\n"
        "write_laz(Path(sys.argv[1]), p, intensity=p[:, 0], extra={'block': p[:, 1].astype('i4')})"
    )
    for threads in ("1", "2"):
        environment = {**os.environ, "RAYON_NUM_THREADS": threads}
        subprocess.run([sys.executable, "-c", code, str(tmp_path / f"{threads}.laz")], check=True, env=environment)
    assert (tmp_path / "1.laz").read_bytes() == (tmp_path / "2.laz").read_bytes()


def test_laz_without_points_without_channels_and_with_exact_intensity(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, np.empty((0, 3)), intensity=np.empty(0), extra={"block": np.empty(0, dtype=np.int32)})
    assert len(read_laz(path).points) == 0
    write_laz(path, np.ones((2, 3)))
    read = read_laz(path)
    assert (read.intensity, read.gps_time, read.extra) == (None, None, {})
    exact = np.array([1e-7, 300.0], dtype=np.float32)
    write_laz(path, np.ones((2, 3)), intensity=exact, extra={EXACT_INTENSITY: exact})
    np.testing.assert_array_equal(read_laz(path).intensity, exact)
    with pytest.raises(ValueError, match="finite"):
        write_laz(path, np.array([[0.0, np.nan, 0.0]]))


def test_laz_damaged_files_are_input_errors(tmp_path: Path, cloud: PointCloud) -> None:
    for suffix in (".laz", ".las"):
        whole, cut = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
        write_laz(whole, cloud.points[:1000], extra={"block": np.ones(1000, dtype=np.int32)})
        data = whole.read_bytes()
        for size in (0, 3, 100, 227, 375, 500, 1000, len(data) // 2, len(data) - 1):
            cut.write_bytes(data[:size])
            with pytest.raises(InputError):
                read_laz(cut)
    with pytest.raises(InputError, match="No such file"):
        read_laz(tmp_path / "none.laz")


def test_laz_absurd_chunk_table_is_an_input_error(tmp_path: Path, cloud: PointCloud) -> None:
    """lazrs alone would ask for gigabytes and abort the process."""
    path = tmp_path / "a.laz"
    write_laz(path, cloud.points[:1000])
    data = bytearray(path.read_bytes())
    with laspy.open(path) as reader:
        start = reader.header.offset_to_point_data
    table = int.from_bytes(data[start : start + 8], "little")
    data[table + 4 : table + 8] = (2_000_000_000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(InputError, match="chunks for 1,000 points"):
        read_laz(path)


def test_laz_absurd_chunk_size_and_records_are_input_errors(tmp_path: Path, cloud: PointCloud) -> None:
    """lazrs alone would abort the process, laspy look for four billion records."""
    path = tmp_path / "a.laz"
    write_laz(path, cloud.points[:1000])
    data = path.read_bytes()
    record = data.find(b"laszip encoded") - 2 + 54
    for at, problem in ((record + 12, "chunks of 4,294,967,280 points"), (100, "records in"), (243, "records in")):
        path.write_bytes(data[:at] + (2**32 - 16).to_bytes(4, "little") + data[at + 4 :])
        with pytest.raises(InputError, match=problem):
            read_laz(path)


# --- PLY


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
    path = tmp_path / "a.ply"
    write_ply(path, mesh)
    theirs = trimesh.load(path, process=False)
    np.testing.assert_array_equal(theirs.vertices, mesh.vertices)
    np.testing.assert_array_equal(theirs.faces, mesh.faces)
    read = open3d.io.read_triangle_mesh(str(path))
    np.testing.assert_array_equal(np.asarray(read.vertices), mesh.vertices)
    np.testing.assert_array_equal(np.asarray(read.triangles), mesh.faces)


def test_ply_of_trimesh_and_open3d(tmp_path: Path, mesh: TriangleMesh) -> None:
    """Their float32 keeps 0.25 m of UTM: compare in local coordinates."""
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
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\none\n", "not a whole PLY"),
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


# --- TIFF


def test_geotiff_as_gdal_reads_it(tmp_path: Path, raster: np.ndarray) -> None:
    path = tmp_path / "difference_001.tif"
    write_geotiff(path, raster, GRID, description="reference minus epoch, m")
    with rasterio.open(path) as data:
        assert data.transform.almost_equals(rasterio.Affine(0.02, 0, 1.25, 0, -0.02, 9.5), precision=1e-12)
        assert data.res == (0.02, 0.02)
        assert np.isnan(data.nodata)
        assert data.dtypes == ("float32",)
        assert data.tags()["AREA_OR_POINT"] == "Area"
        assert data.tags()["TIFFTAG_IMAGEDESCRIPTION"] == "reference minus epoch, m"
        assert not data.crs.is_geographic
        assert not data.crs.is_projected
        assert "wall frame" in data.crs.to_wkt()
        assert 'UNIT["metre",1' in data.crs.to_wkt()
        np.testing.assert_array_equal(data.read(1), raster)
        assert data.read(1, masked=True).mask.sum() == np.isnan(raster).sum()
        assert data.index(1.25 + 10.5 * 0.02, 9.5 - 3.5 * 0.02) == (3, 10)


def test_tiff_round_trips(tmp_path: Path, raster: np.ndarray) -> None:
    for description in ("", "a difference"):
        write_geotiff(tmp_path / "a.tif", raster, GRID, description=description)
        read, grid = read_geotiff(tmp_path / "a.tif")
        np.testing.assert_array_equal(read, raster)
        assert grid == GRID
    write_tiff(tmp_path / "b.tif", raster.astype(np.float64), description="depth, m")
    np.testing.assert_array_equal(read_tiff(tmp_path / "b.tif"), raster)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "b.tif"), raster)
    with pytest.raises(InputError, match="no place"):
        read_geotiff(tmp_path / "b.tif")
    with pytest.raises(ValueError, match=r"\(40, 70\)"):
        write_geotiff(tmp_path / "c.tif", raster.T, GRID)


def test_geotiff_of_gdal(tmp_path: Path, raster: np.ndarray) -> None:
    """Deflated, with another number for no data, without coordinate system."""
    path, marked = tmp_path / "a.tif", np.nan_to_num(raster, nan=-9999)
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "width": 70,
        "height": 40,
        "count": 1,
        "nodata": -9999,
        "compress": "deflate",
    }
    with rasterio.open(path, "w", transform=rasterio.Affine(0.02, 0, 1.25, 0, -0.02, 9.5), **profile) as data:
        data.write(marked, 1)
    read, grid = read_geotiff(path)
    np.testing.assert_array_equal(read, raster)
    assert (grid.x_min, grid.y_max, grid.shape) == (GRID.x_min, GRID.y_max, GRID.shape)
    assert grid.gsd == pytest.approx(GRID.gsd, rel=1e-12)


def test_tiff_damaged_files_are_input_errors(tmp_path: Path, raster: np.ndarray) -> None:
    path = tmp_path / "a.tif"
    write_geotiff(path, raster, GRID)
    data = path.read_bytes()
    for cut in (b"", b"II", b"garbage" * 100, data[:50], data[: len(data) // 2], data[:-1]):
        path.write_bytes(cut)
        with pytest.raises(InputError):
            read_geotiff(path)
    with pytest.raises(InputError, match="No such file"):
        read_tiff(tmp_path / "none.tif")
    tifffile.imwrite(path, np.zeros((8, 8, 3), dtype=np.uint8))
    with pytest.raises(InputError, match="one band"):
        read_tiff(path)


def test_equal_arguments_give_equal_bytes(tmp_path: Path, cloud: PointCloud, mesh: TriangleMesh, raster: np.ndarray) -> None:
    writers: list[Callable[[Path], None]] = [
        lambda path: write_laz(path, cloud.points, intensity=cloud.intensity, gps_time=cloud.gps_time, extra=cloud.extra),
        lambda path: write_ply(path, mesh),
        lambda path: write_geotiff(path, raster, GRID, description="a"),
        lambda path: write_tiff(path, raster),
    ]
    for write in writers:
        write(tmp_path / "a.laz")
        write(tmp_path / "b.laz")
        assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()
