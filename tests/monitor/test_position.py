"""A position behind the wall turns the sign of all changes, so that the user is told where the file shows another side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from monitor_cases import STATION, UTM, las, points, scan

from pipeline.monitoring.frame import doubt_of_side, wall_frame
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.reading import EpochData
from pipeline.monitoring.report import headline
from pipeline.monitoring.run import monitor_paths

pytestmark = pytest.mark.usefixtures("undrawn")

STOOD = np.array([float(each) for each in STATION.split()])
BEHIND = UTM + np.array([0.0, 60.0, 3.0])


def doubts(data: EpochData, position: np.ndarray) -> list[str]:
    options = MonitorOptions(position=position)
    return doubt_of_side(data, options, wall_frame(data.points, position, None), "march.las")


@pytest.mark.parametrize(("position", "told"), [(STOOD, False), (BEHIND, True)])
def test_scan_lines_show_the_other_side(position: np.ndarray, told: bool, tmp_path: Path) -> None:
    files = [las(tmp_path / f"site_2026-0{month}-01.las", scan(month, step_rad=0.003)) for month in (3, 4)]
    result = monitor_paths(files, tmp_path / "out", MonitorOptions(position=position))
    first = headline(result)[0]
    assert first.startswith("Reference, site_2026-03-01.las: Caution: --position lies behind the wall") is told
    found = [note for note in result.site.notes if "behind the wall" in note]
    assert len(found) == told
    if told:
        place = np.array([float(each) for each in found[0].split("at (")[1].split(")")[0].split(",")])
        assert np.linalg.norm(place - STOOD) < 0.5, "it names the place where the scanner stood"


def test_the_position_in_a_file_counts_too() -> None:
    stated = EpochData(points(20_000, 1), position=STOOD)
    assert doubts(stated, STOOD + 5.0) == []
    (told,) = doubts(stated, BEHIND)
    assert "as the file states" in told


def test_points_in_no_order_show_no_side() -> None:
    assert doubts(EpochData(points(20_000, 1)), BEHIND) == []
