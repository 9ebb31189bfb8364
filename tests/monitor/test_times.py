"""When an epoch was measured, by each of the ways in which files say it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import laspy
import numpy as np
import pytest
from monitor_cases import las, points

from pipeline.monitoring.times import SIDECAR, EpochTime, check_order, parsed_time, time_of
from scene.common.errors import InputError


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("wall_20260314.laz", "2026-03-14T00:00:00Z"),
        ("wall_2026-03-14.laz", "2026-03-14T00:00:00Z"),
        ("20260314_1530_wall.laz", "2026-03-14T15:30:00Z"),
        ("wall-2026-03-14T15-30-05.e57", "2026-03-14T15:30:05Z"),
        ("ScanPos001 - 260314.ply", ""),
        ("wall_20261399.laz", ""),
        ("wall_7.laz", ""),
    ],
)
def test_names(name: str, text: str) -> None:
    assert time_of(Path(name)).text == text


def test_the_user_comes_first_then_the_sidecar(tmp_path: Path) -> None:
    path = tmp_path / "wall_20260314.xyz"
    (tmp_path / (path.name + SIDECAR)).write_text("2026-03-15T12:00:00+02:00\n")
    assert time_of(path).text == "2026-03-15T10:00:00Z"
    assert time_of(path, "2026-01-01").text == "2026-01-01T00:00:00Z"
    (tmp_path / (path.name + SIDECAR)).write_text("yesterday")
    with pytest.raises(InputError, match="ISO 8601"):
        time_of(path)


def test_gps_time_counts_from_the_standard_date(tmp_path: Path) -> None:
    """GPS seconds run from 1980-01-06 and are 18 ahead of UTC; LAS takes off 1e9."""
    when = datetime(2026, 3, 14, 12, tzinfo=UTC)
    path = las(tmp_path / "wall_19990101.las", points(2000, 1))
    file = laspy.read(path)
    file.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    file.gps_time = np.full(2000, (when - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + 18 - 1e9)
    file.write(path)
    found = time_of(path)
    assert found.when == when
    assert "GPS" in found.source


def test_times_that_run_backwards() -> None:
    times = [EpochTime(parsed_time(text, ""), "") for text in ("2026-03-01", "2026-02-01")]
    with pytest.raises(InputError, match=r"b \(2026-02-01 00:00\) is earlier than a"):
        check_order(times, ["a", "b"])
    with pytest.raises(InputError, match="which is the reference; make the earliest epoch the reference"):
        check_order(times, ["a", "b"])
    with pytest.raises(InputError, match="which comes before it; give the epochs in the order"):
        check_order([times[1], *times], ["0", "a", "b"])
    check_order([times[0], EpochTime(None, ""), times[0]], ["a", "b", "c"])
