"""LAS and LAZ: what is read back is what was written, laspy reads it too, and damaged files are reported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from format_cases import UTM, a_cloud

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import EXACT_INTENSITY, read_laz, write_laz
from scene.common.errors import InputError


@pytest.fixture
def cloud() -> PointCloud:
    return a_cloud()


@pytest.mark.parametrize("suffix", [".laz", ".las"])
def test_laz_round_trip(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_laz(path, cloud)
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
    write_laz(tmp_path / "a.laz", PointCloud(cloud.points))
    with laspy.open(tmp_path / "a.laz") as reader:
        header = reader.header
    assert (str(header.version), header.point_format.id, header.point_count) == ("1.4", 6, len(cloud.points))
    assert header.generating_software == "scarpsim"
    assert header.global_encoding.wkt
    assert header.number_of_points_by_return[0] == len(cloud.points)
    np.testing.assert_allclose(header.mins, cloud.points.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(header.maxs, cloud.points.max(axis=0), atol=1e-6)


def test_laz_claims_no_extremes_of_its_channels(tmp_path: Path, cloud: PointCloud) -> None:
    """The file states no minimum and maximum of its channels; laspy would write the first point's value as both."""
    write_laz(tmp_path / "a.laz", cloud)
    with laspy.open(tmp_path / "a.laz") as reader:
        (record,) = reader.header.vlrs.get("ExtraBytesVlr")
    assert [each.name.decode() for each in record.extra_bytes_structs] == list(cloud.extra)
    assert not any(each.min_is_relevant() or each.max_is_relevant() for each in record.extra_bytes_structs)


@pytest.mark.parametrize(("extent_m", "step_m"), [(70.0, 1e-6), (5000.0, 1e-5), (1e6, 1e-3)])
def test_laz_keeps_large_coordinates(tmp_path: Path, extent_m: float, step_m: float) -> None:
    points = UTM + np.random.default_rng(4).uniform(-0.5, 0.5, (1000, 3)) * extent_m
    points[:2] = UTM - extent_m / 2, UTM + extent_m / 2
    write_laz(tmp_path / "a.laz", PointCloud(points))
    np.testing.assert_allclose(read_laz(tmp_path / "a.laz").points, points, rtol=0, atol=0.51 * step_m)


def test_laz_bytes_do_not_depend_on_threads(tmp_path: Path) -> None:
    code = (
        "import sys, numpy as np; from pathlib import Path; from pipeline.formats.points.laz import write_laz\n"
        "from pipeline.formats.point_cloud import PointCloud\n"
        "p = np.random.default_rng(0).uniform(0, 70, (160_000, 3))\n"
        "write_laz(Path(sys.argv[1]), PointCloud(p, p[:, 0], extra={'block': p[:, 1].astype('i4')}))"
    )
    for threads in ("1", "2"):
        environment = {**os.environ, "RAYON_NUM_THREADS": threads}
        subprocess.run([sys.executable, "-c", code, str(tmp_path / f"{threads}.laz")], check=True, env=environment)
    assert (tmp_path / "1.laz").read_bytes() == (tmp_path / "2.laz").read_bytes()


def test_laz_without_points_without_channels_and_with_exact_intensity(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, PointCloud(np.empty((0, 3)), np.empty(0), extra={"block": np.empty(0, dtype=np.int32)}))
    assert len(read_laz(path).points) == 0
    write_laz(path, PointCloud(np.ones((2, 3))))
    read = read_laz(path)
    assert (read.intensity, read.gps_time, read.extra) == (None, None, {})
    exact = np.array([1e-7, 300.0], dtype=np.float32)
    write_laz(path, PointCloud(np.ones((2, 3)), exact, extra={EXACT_INTENSITY: exact}))
    np.testing.assert_array_equal(read_laz(path).intensity, exact)
    with pytest.raises(ValueError, match="finite"):
        write_laz(path, PointCloud(np.array([[0.0, np.nan, 0.0]])))


def test_laz_damaged_files_are_input_errors(tmp_path: Path, cloud: PointCloud) -> None:
    for suffix in (".laz", ".las"):
        whole, cut = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
        write_laz(whole, PointCloud(cloud.points[:1000], extra={"block": np.ones(1000, dtype=np.int32)}))
        data = whole.read_bytes()
        for size in (0, 3, 100, 227, 375, 500, 1000, len(data) // 2, len(data) - 1):
            cut.write_bytes(data[:size])
            with pytest.raises(InputError):
                read_laz(cut)
    with pytest.raises(InputError, match="No such file"):
        read_laz(tmp_path / "none.laz")


def test_laz_absurd_chunk_table_is_an_input_error(tmp_path: Path, cloud: PointCloud) -> None:
    """An absurd chunk table is refused; lazrs alone would ask for gigabytes and abort the process."""
    path = tmp_path / "a.laz"
    write_laz(path, PointCloud(cloud.points[:1000]))
    data = bytearray(path.read_bytes())
    with laspy.open(path) as reader:
        start = reader.header.offset_to_point_data
    table = int.from_bytes(data[start : start + 8], "little")
    data[table + 4 : table + 8] = (2_000_000_000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(InputError, match="chunks for 1,000 points"):
        read_laz(path)


def test_laz_absurd_chunk_size_and_records_are_input_errors(tmp_path: Path, cloud: PointCloud) -> None:
    """Absurd numbers are refused; lazrs alone would abort the process, and laspy would look for four billion records."""
    path = tmp_path / "a.laz"
    write_laz(path, PointCloud(cloud.points[:1000]))
    data = path.read_bytes()
    record = data.find(b"laszip encoded") - 2 + 54
    for at, problem in ((record + 12, "chunks of 4,294,967,280 points"), (100, "records in"), (243, "records in")):
        path.write_bytes(data[:at] + (2**32 - 16).to_bytes(4, "little") + data[at + 4 :])
        with pytest.raises(InputError, match=problem):
            read_laz(path)
