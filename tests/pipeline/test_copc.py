"""COPC files, read by laspy: it finds every point, the points within bounds, and evenly thinned ones by resolution."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from format_cases import UTM, a_cloud

from pipeline.formats.cameras.crs import wkt_of
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points import copc
from pipeline.formats.points.copc import octree, write_copc
from pipeline.formats.points.laz import LazHeader, PulseChannels, read_laz
from scene.common.errors import InputError

STEP = 0.51e-6


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return a_cloud()


@pytest.fixture(scope="module")
def path(cloud: PointCloud, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("copc") / "a.copc.laz"
    write_copc(out, cloud)
    return out


def test_every_point_comes_back_with_its_channels(cloud: PointCloud, path: Path) -> None:
    with laspy.CopcReader.open(path) as reader:
        found, info = reader.query(), reader.copc_info
    assert cloud.gps_time is not None
    assert len(found) == len(cloud.points)
    order = np.argsort(found.gps_time)  # of ours: rising
    np.testing.assert_array_equal(found.gps_time[order], cloud.gps_time)
    np.testing.assert_allclose(np.stack([found.x, found.y, found.z], axis=1)[order], cloud.points, rtol=0, atol=STEP)
    for name, channel in cloud.extra.items():
        np.testing.assert_array_equal(found[name][order], channel)
    assert (info.gps_min, info.gps_max) == (cloud.gps_time[0], cloud.gps_time[-1])


@pytest.mark.parametrize("size", [1.5, 7.0, 40.0])
def test_a_query_by_bounds_has_the_points_within(cloud: PointCloud, path: Path, size: float) -> None:
    low = np.array([11.0, 13.0, -2.0])
    with laspy.CopcReader.open(path) as reader:
        found = reader.query(bounds=laspy.copc.Bounds(low, low + size))
    within = ((cloud.points > low) & (cloud.points < low + size)).all(axis=1)
    assert 0 < within.sum() == len(found)
    assert cloud.gps_time is not None
    np.testing.assert_array_equal(np.sort(found.gps_time), cloud.gps_time[within])


def test_nodes_hold_the_points_of_their_cubes(path: Path) -> None:
    with laspy.CopcReader.open(path) as reader:
        info = reader.copc_info
        for key, entry in reader.root_page.entries.items():
            points = reader._fetch_and_decompress_points_of_nodes([node_of(entry, key)])
            side = 2 * info.halfsize / 2**key.level
            low = info.center - info.halfsize + np.array([key.x, key.y, key.z]) * side
            places = np.stack([points.x, points.y, points.z], axis=1)
            assert (places >= low - 1e-9).all()
            assert (places <= low + side + 1e-9).all()


def node_of(entry: laspy.copc.Entry, key: laspy.copc.VoxelKey) -> laspy.copc.OctreeNode:
    node = laspy.copc.OctreeNode()
    node.key, node.offset, node.byte_size, node.point_count = key, entry.offset, entry.byte_size, entry.point_count
    return node


def test_a_query_by_resolution_has_a_point_in_each_cell(path: Path) -> None:
    """The levels up to k have one point in each cell of spacing / 2^k; all levels have all points.

    The points lie on a flat wall, 4 cm apart.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 32, 0.04), np.arange(0, 16, 0.04)))
    wall = path.with_name("wall.copc.laz")
    write_copc(wall, PointCloud(np.stack([x, y, 0.01 * np.sin(x)], axis=1)))
    with laspy.CopcReader.open(wall) as reader:
        low, spacing = reader.header.mins, reader.copc_info.spacing
        assert spacing == pytest.approx((reader.header.maxs - low).max() / 128)
        numbers = [len(reader.query(resolution=spacing / 2**level)) for level in range(4)]
        for level in (0, 1):
            coarse = reader.query(resolution=spacing / 2**level)
            cells = np.floor((np.stack([coarse.x, coarse.y], axis=1) - low[:2]) / (spacing / 2**level)).astype(int)
            assert len(np.unique(cells, axis=0)) >= 0.999 * 128 * 64 * 4**level
    assert numbers == sorted(numbers)
    assert numbers[0] < 1.1 * 128 * 64
    assert numbers[-1] == len(x)


def test_the_file_is_laid_out_as_the_specification_says(path: Path) -> None:
    data = path.read_bytes()
    assert data[104] == 6 | 0x80  # point format 6, compressed
    assert data[377:393].rstrip(b"\0") == b"copc"
    assert struct.unpack_from("<HH", data, 393) == (1, 160)
    place, size = struct.unpack_from("<2Q", data, 429 + 40)
    (start,), (count,) = struct.unpack_from("<Q", data, 235), struct.unpack_from("<I", data, 243)
    assert (start + 60, count) == (place, 1)
    assert data[start + 2 : start + 18].rstrip(b"\0") == b"copc"
    assert struct.unpack_from("<HQ", data, start + 18) == (1000, size)
    assert place + size == len(data)


def test_it_reads_as_laz_too(cloud: PointCloud, path: Path) -> None:
    read = read_laz(path)
    assert read.gps_time is not None
    order = np.argsort(read.gps_time)
    np.testing.assert_allclose(read.points[order], cloud.points, rtol=0, atol=STEP)
    np.testing.assert_array_equal(read.extra["block"][order], cloud.extra["block"])


def test_pieces_and_repetition_leave_the_bytes_as_they_are(
    cloud: PointCloud, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_copc(path.with_name("again.copc.laz"), cloud)
    assert path.with_name("again.copc.laz").read_bytes() == path.read_bytes()
    monkeypatch.setattr(copc, "_BATCH", 20_000)
    write_copc(path.with_name("pieces.copc.laz"), cloud)
    assert path.with_name("pieces.copc.laz").read_bytes() == path.read_bytes()


def test_a_survey_with_its_system_and_returns(tmp_path: Path) -> None:
    points = UTM + np.random.default_rng(2).uniform(-20, 20, (3000, 3))
    number = np.arange(3000) % 2 + 1
    pulses = PulseChannels(number, np.full(3000, 2), np.linspace(0, 1, 3000))
    write_copc(tmp_path / "a.copc.laz", PointCloud(points), pulses, LazHeader(wkt=wkt_of("EPSG:28356", "test")))
    with laspy.CopcReader.open(tmp_path / "a.copc.laz") as reader:
        found, crs = reader.query(), reader.header.parse_crs()
        assert reader.header.number_of_points_by_return[:2].tolist() == [1500, 1500]
    assert crs is not None
    assert crs.to_epsg() == 28356
    assert np.abs(np.sort(found.x) - np.sort(points[:, 0])).max() < STEP


@pytest.mark.parametrize("count", [1, 40_000])
def test_points_at_one_place(tmp_path: Path, count: int) -> None:
    write_copc(tmp_path / "a.copc.laz", PointCloud(np.full((count, 3), 7.0)))
    with laspy.CopcReader.open(tmp_path / "a.copc.laz") as reader:
        found = reader.query()
    assert len(found) == count
    assert np.ptp(found.x) == 0


def test_a_cloud_without_points_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no points to write"):
        write_copc(tmp_path / "a.copc.laz", PointCloud(np.empty((0, 3))))
    assert not list(tmp_path.iterdir())


def test_the_order_of_points_within_a_node_is_the_given_one() -> None:
    steps = np.random.default_rng(3).integers(0, 10**7, (50_000, 3))
    tree = octree(steps)
    assert sorted(tree.order.tolist()) == list(range(50_000))
    assert tree.counts.sum() == 50_000
    for part in np.split(tree.order, np.cumsum(tree.counts)[:-1]):
        assert (np.diff(part) > 0).all()
