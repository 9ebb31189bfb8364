"""PCD files contain what was written, in the Point Cloud Library's layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.pcd import write_pcd
from scene.common.errors import InputError

_KINDS = {"F": "f", "I": "i", "U": "u"}


def read(path: Path) -> tuple[dict[str, str], np.ndarray[Any, Any]]:
    """Read header and rows by the format's own description."""
    head, body = path.read_bytes().split(b"DATA binary\n", 1)
    header = dict(line.split(" ", 1) for line in head.decode("ascii").splitlines() if not line.startswith("#"))
    columns = zip(*(header[name].split() for name in ("FIELDS", "TYPE", "SIZE")), strict=True)
    kind = np.dtype([(name, f"<{_KINDS[letter]}{size}") for name, letter, size in columns])
    return header, np.frombuffer(body, kind)


def test_a_cloud_comes_back(tmp_path: Path) -> None:
    points = np.random.default_rng(1).uniform(-60, 60, (50, 3))
    extra = {"block": np.arange(50, dtype=np.int32), "seen": np.arange(50) % 2 == 0}
    write_pcd(tmp_path / "a.pcd", PointCloud(points, np.linspace(0, 1, 50), np.arange(50.0), extra))
    header, rows = read(tmp_path / "a.pcd")
    assert header["FIELDS"] == "x y z intensity gps_time block seen"
    assert header["SIZE"] == "4 4 4 8 8 4 1"
    assert header["COUNT"] == "1 1 1 1 1 1 1"
    assert (header["WIDTH"], header["HEIGHT"], header["POINTS"]) == ("50", "1", "50")
    assert np.abs(np.stack([rows[axis] for axis in "xyz"], axis=1) - points).max() < 4e-6
    np.testing.assert_array_equal(rows["block"], extra["block"])
    np.testing.assert_array_equal(rows["seen"], extra["seen"])


def test_coordinates_of_a_survey_keep_their_millimetres(tmp_path: Path) -> None:
    points = np.array([[345200.1234, 6389450.5678, 120.9]])
    write_pcd(tmp_path / "a.pcd", PointCloud(points))
    header, rows = read(tmp_path / "a.pcd")
    assert header["SIZE"] == "8 8 8"
    assert [rows[axis][0] for axis in "xyz"] == points[0].tolist()


def test_a_cloud_without_points_and_a_channel_that_is_no_number(tmp_path: Path) -> None:
    write_pcd(tmp_path / "none.pcd", PointCloud(np.empty((0, 3))))
    assert len(read(tmp_path / "none.pcd")[1]) == 0
    with pytest.raises(InputError, match="name: the channel has the type"):
        write_pcd(tmp_path / "a.pcd", PointCloud(np.zeros((1, 3)), extra={"name": np.array(["a"])}))
