"""The config chooses what a run writes; products in world coordinates state their coordinate system."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from pipeline import configure, make_wall, open_run, simulate
from pipeline.formats.points.e57 import read_e57
from pipeline.formats.points.points import read_points
from scene import InputError

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL: dict[str, Any] = {
    "station__distance_m": 20.0, "scanner__azimuth_step_rad": 0.004, "scanner__zenith_step_rad": 0.004,
    "difference__gsd_m": 0.1, "rockfall__count": 1, "rockfall__safe_zone_offset_m": 0.2,
}  # fmt: skip
ORIGIN = np.array([345200.0, 6389450.0, 120.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on an imported wall in survey coordinates."""
    place = tmp_path_factory.mktemp("chosen")
    wall = make_wall(style="pilkington", width_m=6.0, height_m=4.0, resolution_m=0.2)
    path = wall.with_vertices(wall.vertices + ORIGIN).save(place / "wall.ply")  # type: ignore[attr-defined]
    chosen = {"truth": False, "surface": False, "crs": "EPSG:28356", "formats": ["copc", "xyz", "ply", "e57", "pcd"]}
    return simulate(None, "tls", out=place / "run", progress=False, wall={"mesh": path}, products=chosen, **SMALL).folder


def test_only_what_was_chosen_is_written(folder: Path) -> None:
    names = {path.name for path in (folder / "epoch_001").iterdir()}
    points = {f"points{world}.{suffix}" for world in ("", "_world") for suffix in ("laz", "copc.laz", "xyz", "ply", "e57", "pcd")}
    assert names == {*points, "blocks.json", "epoch.json"}
    with pytest.raises(InputError, match=r"did not write surface\.ply.*products"):
        _ = open_run(folder)[1].surface


def test_the_map_has_its_style_beside_it(folder: Path) -> None:
    assert "singlebandpseudocolor" in (folder / "difference_001.qml").read_text()


def test_world_points_state_their_system(folder: Path) -> None:
    for name in ("points_world.laz", "points_world.copc.laz"):
        with laspy.open(folder / "epoch_001" / name) as file:
            crs = file.header.parse_crs()
            assert file.header.global_encoding.wkt
        assert crs is not None
        assert crs.to_epsg() == 28356
    with laspy.open(folder / "epoch_001" / "points.laz") as file:
        assert file.header.parse_crs() is None


@pytest.mark.parametrize("suffix", ["laz", "copc.laz", "xyz", "ply", "e57"])
def test_world_points_are_the_wall_frames_moved(suffix: str, folder: Path) -> None:
    frame = open_run(folder).frame
    local = read_points(folder / "epoch_001" / "points.laz").points
    world = read_points(folder / "epoch_001" / f"points_world.{suffix}").points
    assert np.abs(world - frame.to_world(local)).max() < 2e-5
    assert np.abs(world.mean(axis=0) - ORIGIN).max() < 20


def test_the_e57_scan_stands_where_the_scanner_does(folder: Path) -> None:
    (scan,) = read_e57(folder / "epoch_001" / "points_world.e57")
    run = open_run(folder)
    (local,) = read_e57(folder / "epoch_001" / "points.e57")
    assert np.allclose(scan.position, run.frame.to_world(local.position), atol=1e-6)


@pytest.mark.parametrize(
    ("crs", "problem"),
    [
        ("EPSG:999999", "products.crs: the coordinate system is not understood: 'EPSG:999999'"),
        ("EPSG:4326", "'WGS 84' has the unit degree; allowed: a projected"),
        ("EPSG:2222", "has the unit foot"),
    ],
)
def test_a_wrong_system_is_told_before_anything_is_simulated(crs: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=problem):
        simulate(configure(products={"crs": crs}), "tls", out=tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()
