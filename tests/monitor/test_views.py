"""Walls that turn a corner or overhang: each part has maps of its own, and what fell from any of them is found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from monitor_cases import las, points

from pipeline.api.monitoring import Monitoring
from pipeline.formats.points.laz import read_laz
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.monitoring.options import MonitorOptions, read_areas
from pipeline.monitoring.products import Result
from pipeline.monitoring.run import monitor_paths
from pipeline.monitoring.views import divided
from pipeline.monitoring.write_site import write_site
from pipeline.view.monitor_results import MonitorResults
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

STATION = np.array([22.0, -22.0, 4.0])
"""Before both faces of the corner."""
SIDE_M, DEEP_M = 0.8, 0.2
VOLUME = SIDE_M**2 * DEEP_M


def corner(seed: int, *, fallen: bool = False, count: int = 120_000) -> FloatArray:
    """(n, 3) points of two faces of 12 m x 8 m at a right angle, y = 0 and x = 0, with relief; fallen: a block in each."""
    random = np.random.default_rng(seed)
    faces = []
    for face in (0, 1):
        along, up = random.uniform([0.3, 0], [12, 8], (count // 2, 2)).T
        out = 0.15 * np.sin(1.3 * along + face) * np.cos(0.9 * up) + 0.003 * random.normal(size=len(along))
        if fallen:
            inside = (np.abs(along - 6 - face) < SIDE_M / 2) & (np.abs(up - 4) < SIDE_M / 2)
            out = np.where(inside, out - DEEP_M, out)
        faces.append(np.column_stack([along, -out, up] if face == 0 else [out, -along, up]))
    return np.concatenate(faces)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    base = tmp_path_factory.mktemp("corner")
    files = [
        las(base / "2026-03-01.las", corner(1)),
        las(base / "2026-04-01.las", corner(2, fallen=True) + np.array([0.02, -0.03, 0.01])),
    ]
    result = monitor_paths(files, base / "out", MonitorOptions(position=STATION))
    write_site(result, base / "site.yaml")
    return result


@pytest.fixture(scope="module")
def folder(result: Result) -> Path:
    return result.folder


def test_a_block_is_found_in_each_face_of_a_corner(folder: Path) -> None:
    events = json.loads((folder / "monitor.json").read_text())["events"]
    assert sorted(each["view"] for each in events) == [1, 2]
    for each in events:
        assert each["kind"] == "missing"
        assert each["volume_m3"] == pytest.approx(VOLUME, rel=0.1)
        assert each["depth_largest_m"] == pytest.approx(DEEP_M, rel=0.1)
    places = sorted((round(each["world_x_m"]), round(-each["world_y_m"]), round(each["world_z_m"])) for each in events)
    assert places == [(0, 7, 4), (6, 0, 4)]


def test_both_faces_are_registered_together(folder: Path) -> None:
    """The shift along each face is determined by the other one: registered points are back within 2 mm."""
    moved = read_laz(folder / "epoch_001.laz")
    np.testing.assert_allclose(np.median(moved.points - corner(2, fallen=True), axis=0), 0.0, atol=2e-3)
    assert np.isfinite(moved.extra["distance_m"]).mean() > 0.97
    assert len(np.unique(moved.extra["event"])) == 3


def test_each_view_has_its_files(folder: Path) -> None:
    views = json.loads((folder / "monitor.json").read_text())["views"]
    assert [each["suffix"] for each in views] == ["", "_view2"]
    for suffix in ("", "_view2"):
        difference, grid = read_geotiff(folder / f"difference_001{suffix}.tif")
        assert np.nanmax(difference) == pytest.approx(DEEP_M, abs=0.02)
        assert np.isfinite(difference).sum() * grid.gsd**2 == pytest.approx(12 * 8, rel=0.1)
        assert (folder / f"map_001{suffix}.png").is_file()
    assert (folder.parent / "site_wall.ply").is_file()


def test_python_has_the_maps_of_each_view(result: Result) -> None:
    found = Monitoring(result)
    first, second = found.differences, found.differences_in(2)
    assert first.dims == second.dims == ("epoch", "y", "x")
    assert float(second.max()) == pytest.approx(DEEP_M, abs=0.02)
    assert not np.array_equal(first, second)
    assert found.plot().png != found.plot(view=2).png
    with pytest.raises(InputError, match="there is no view 3"):
        found.differences_in(3)


def test_the_viewer_shows_each_view(folder: Path) -> None:
    shown = MonitorResults(folder)
    assert len(shown.steps) == 2
    for step in shown.steps:
        assert len(shown.items(step)) == 1
        patch = shown.patch(step, "epoch", shown.layers(step)[0], None, 10_000)
        assert len(np.unique(patch.label)) == 2


def test_an_overhang_has_a_view_of_its_own() -> None:
    """A wall, a roof under which one stands, and the wall above: the roof looks down."""
    random = np.random.default_rng(3)
    x, s = random.uniform([0, 0], [10, 9], (60_000, 2)).T
    wall = np.column_stack(
        [x, np.where(s < 3, 0.0, np.where(s < 6, 3 - s, -3.0)), np.where(s < 3, s, np.where(s < 6, 3.0, s - 3))]
    )
    found = divided(wall, np.array([5.0, -30.0, 1.0]), np.array([0.0, -1.0, 0.0]), None)
    assert found is not None
    assert len(found.directions) == 2
    assert found.directions[1] @ [0, 0, -1] > 0.95
    roof = (s > 3.4) & (s < 5.6)
    assert (found.of(wall[roof]) == 1).mean() > 0.97
    assert (found.of(wall[(s < 2.6) | (s > 6.4)]) == 0).mean() > 0.97


def test_a_wall_without_a_corner_has_one_view() -> None:
    wall = points(50_000, 1) - points(50_000, 1).mean(axis=0)
    assert divided(wall, np.array([0.0, -50.0, 0.0]), np.array([0.0, -1.0, 0.0]), None) is None


def test_points_in_the_order_of_a_raster_have_one_view() -> None:
    """A rough elevation model whose every eighth height lies in every eighth column."""
    x, y = np.meshgrid(0.1 * np.arange(200), 0.1 * np.arange(120))
    z = 0.3 * np.sin(2 * x) * np.cos(2 * y) + 0.1 * np.sin(9 * x + 7 * y)
    heights = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    assert divided(heights, np.array([10.0, 6.0, 100.0]), np.array([0.0, 0.0, 1.0]), None) is None


def test_a_rough_face_is_whole_from_a_place_nearly_in_its_plane() -> None:
    """The face x = 0 is rough, and the place stands at 6 degrees to it: all of it faces +x, as its mean does."""
    points = corner(1)
    face = points[:, 0] < 1.0
    points[face, 0] += 0.3 * np.sin(3 * points[face, 1]) * np.cos(2.5 * points[face, 2])
    found = divided(points, np.array([4.0, -40.0, 4.0]), np.array([0.0, -1.0, 0.0]), None)
    assert found is not None
    far = np.flatnonzero(face & (points[:, 1] < -2.5))
    facing = found.directions[found.of(points[far])] @ np.array([1.0, 0.0, 0.0])
    assert (facing > 0.5).mean() > 0.97


@pytest.mark.usefixtures("undrawn_here")
def test_the_number_of_views_can_be_given(tmp_path: Path) -> None:
    files = [las(tmp_path / "a.las", corner(1)), las(tmp_path / "b.las", corner(2))]
    one = monitor_paths(files, tmp_path / "one", MonitorOptions(position=STATION, views=1))
    assert len(one.site.views) == 1
    with pytest.raises(InputError, match="--views"):
        monitor_paths(files, tmp_path / "none", MonitorOptions(position=STATION, views=7))


@pytest.mark.usefixtures("undrawn_here")
def test_stable_areas_in_survey_coordinates_hold_for_every_view(tmp_path: Path) -> None:
    """A box on one face and a polygon on the other, x, y and z: only pixels in them are stable, and both faces have some."""
    files = [las(tmp_path / "2026-03-01.las", corner(1)), las(tmp_path / "2026-04-01.las", corner(2, fallen=True))]
    low, high = np.array([1.0, -1.0, 0.5]), np.array([4.0, 1.0, 7.5])
    face = np.array([[0.0, -1.0, 0.5], [0.0, -4.0, 0.5], [0.0, -4.0, 7.5], [0.0, -1.0, 7.5]])
    areas = tmp_path / "stable.yaml"
    areas.write_text(json.dumps({"stable_areas": [[*low, *high], face.tolist()]}), encoding="utf-8")
    result = monitor_paths(files, tmp_path / "out", MonitorOptions(position=STATION, stable=read_areas(areas)))
    (epoch,) = result.epochs
    area = epoch.record.registration["stable_pixels"] * result.site.grid.gsd**2
    assert area == pytest.approx(2 * 3.0 * 7.0, rel=0.05)
    assert sorted(region.view for region in epoch.regions) == [1, 2]
