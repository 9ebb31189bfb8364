"""The folder of `monitor` in the viewer: steps, layers, items and points are those of the files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from monitor_cases import STATION, las, points

from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.run import monitor_paths
from pipeline.view.figures import map_figure, wall_figure
from pipeline.view.monitor_results import MonitorResults
from pipeline.view.server import make_app, open_results
from scene.common.errors import InputError

ALL = 1_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("monitored")
    files = [
        las(base / "2026-03-01.las", points(60_000, 1)),
        las(base / "2026-04-01.las", points(60_000, 2, ((5.0, 5.0, 1.0, 0.3),))),
    ]
    options = MonitorOptions(position=np.array([float(each) for each in STATION.split()]))
    return monitor_paths(files, base / "out", options).folder


def test_what_is_shown_is_what_the_files_hold(folder: Path) -> None:
    shown = open_results(folder)
    assert isinstance(shown, MonitorResults)
    assert list(shown.steps) == ["1"]
    assert "2026-04-01" in shown.steps["1"]
    difference, level, *_ = shown.layers("1")
    change, _ = read_geotiff(folder / "difference_001.tif")
    np.testing.assert_allclose(shown.patch("1", "epoch", difference, None, ALL).value, 1e3 * change, rtol=1e-5)
    assert np.nanmedian(shown.patch("1", "reference", level, None, ALL).value) > 0
    before, after = (shown.patch("1", surface, difference, None, ALL).height for surface in ("reference", "epoch"))
    np.testing.assert_allclose(np.nanmax(before - after), 0.3, atol=0.03)


def test_events_can_be_clicked_on(folder: Path) -> None:
    shown = MonitorResults(folder)
    (row,) = csv.DictReader((folder / "events.csv").open())
    (item,) = shown.items("1")
    assert item.name == f"event {row['id']}"
    assert item.box[0] < float(row["x_m"]) < item.box[1]
    assert item.facts["kind"] == "missing rock"
    patch = shown.patch("1", "epoch", shown.layers("1")[0], None, 10_000)
    assert set(np.unique(patch.label)) == {0, 1}
    for figure in (wall_figure(patch, None, [item], shown.layers("1")[0], {"surface", "event"}),):
        assert any("event" in str(trace.to_plotly_json()) for trace in figure.data)
    assert map_figure(patch, [item], shown.layers("1")[0], {"event"}, None).data


def test_points_have_their_change(folder: Path) -> None:
    found = MonitorResults(folder).points("1", MonitorResults(folder).layers("1")[0], None, 500)
    assert found is not None
    assert {"distance_m", "lod_m", "event"} <= set(found.facts)
    assert len(found.points) <= 500


def test_the_page_is_made(folder: Path) -> None:
    assert make_app(open_results(folder), "token").layout is not None


def test_a_damaged_record_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "monitor.json").write_text("{}")
    with pytest.raises(InputError, match=r"is not a record of scarpsim monitor"):
        open_results(tmp_path)
