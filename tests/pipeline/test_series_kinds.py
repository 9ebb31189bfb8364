"""Series of other kinds: seen by the stereo pair, not cumulative, under snow and plants, and with one thread."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pictures import ENVIRONMENT, command
from test_series import EVENTS, SMALL, TIMES, config, digests

from pipeline.config.simulation import SimulationConfig
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.run.simulation import simulate
from scene.common.config import parse
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.series.cover import Cover

pytestmark = pytest.mark.usefixtures("undrawn")

CAMERAS = {"cameras": {"distance_m": 15.0, "width": 368, "height": 246}}
UP = np.array([0.0, 1.0, 0.0])


def largest_near(folder: Path, epoch: int, event: dict[str, Any]) -> float:
    """Largest difference within 0.3 m of an event's place, m."""
    values, grid = read_geotiff(folder / f"difference_{epoch:03d}.tif")
    rows, columns = np.mgrid[: grid.height, : grid.width] + 0.5
    x, y = grid.x_min + columns * grid.gsd, grid.y_max - rows * grid.gsd
    near = np.hypot(x - event["position_m"][0], y - event["position_m"][1]) < 0.3
    return float(np.nanmax(values[near]))


def test_without_cumulation_an_epoch_misses_only_what_fell_since_the_last(tmp_path: Path) -> None:
    simulate(config({"events": EVENTS, "cumulative": False}), "tls", tmp_path / "run")
    first, second = EVENTS
    shown = [[largest_near(tmp_path / "run", epoch, each) > 0.05 for epoch in (1, 2, 3)] for each in (first, second)]
    assert shown == [[True, False, False], [False, False, True]]
    assert json.loads((tmp_path / "run/series.json").read_text())["cumulative"] is False


def test_the_stereo_pair_sees_what_fell_in_every_later_epoch(tmp_path: Path) -> None:
    simulate(config({"events": EVENTS}, **CAMERAS), "stereo", tmp_path / "run")
    shown = [largest_near(tmp_path / "run", epoch, EVENTS[0]) > 0.05 for epoch in (1, 2, 3)]
    assert shown == [True, True, True]


def test_one_thread_makes_the_same_bytes(tmp_path: Path) -> None:
    """Epochs with what fell, its deposit, a precursor and a pose of its own."""
    times = {**TIMES, "count": 2}
    series = {
        "times": times,
        "events": EVENTS,
        "deposits": {"fragments": 3},
        "conditions": {"pose": {"position_m": {"random_walk": 0.002}}},
    }
    simulate(config(series), "tls", tmp_path / "all")
    (tmp_path / "config.yaml").write_text(json.dumps({**SMALL, "series": series}))  # JSON is YAML
    words = ["--sensor", "tls", "--config", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "one"), "--threads", "1"]
    subprocess.run(command("simulate", *words, "--quiet"), check=True, env=ENVIRONMENT, timeout=300)
    assert digests(tmp_path / "one") == digests(tmp_path / "all")


def slope(angle_deg: float) -> TriangleMesh:
    """A plane of 4 m x 4 m whose normal is `angle_deg` from the vertical."""
    across, along = (each.ravel() for each in np.meshgrid(np.linspace(0, 4, 60), np.linspace(0, 4, 60)))
    angle = np.radians(angle_deg)
    places = np.stack([across, -along * np.sin(angle), along * np.cos(angle)], axis=1)
    first = np.arange(60 * 60).reshape(60, 60)[:-1, :-1].ravel()
    sides = [np.stack([first, first + 1, first + 61], 1), np.stack([first, first + 61, first + 60], 1)]
    mesh = TriangleMesh(places, np.concatenate(sides).astype(np.int32))
    return mesh if mesh.vertex_normals()[0] @ UP > 0 else mesh.with_vertices(places * [-1, 1, 1])


@pytest.mark.parametrize(("angle_deg", "share"), [(10.0, 1.0), (30.0, 1.0), (60.0, 0.0), (80.0, 0.0)])
def test_snow_lies_on_level_rock_and_not_on_steep_rock(angle_deg: float, share: float) -> None:
    rock = slope(angle_deg)
    moved = Cover(snow_m=0.2).on(rock, UP, KeyedRandom(1)).vertices - rock.vertices
    np.testing.assert_allclose(moved, np.tile(0.2 * share * UP, (len(moved), 1)), atol=1e-12)


def test_plants_grow_outwards_in_patches_up_to_their_height() -> None:
    rock = slope(80.0)
    moved = Cover(vegetation_m=0.3).on(rock, UP, KeyedRandom(1)).vertices - rock.vertices
    height = np.einsum("ij,ij->i", moved, rock.vertex_normals())
    assert height.max() == pytest.approx(0.3)
    assert height.min() == 0.0
    assert 0.2 < (height > 0).mean() < 0.8
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), height, atol=1e-12)


def test_snow_of_an_epoch_shows_as_added_material(tmp_path: Path) -> None:
    snow = {"snow_m": {"table": {"hours": [0, 6, 12], "values": [0, 0.1, 0]}}}
    values = {**SMALL, "series": {"times": {**TIMES, "count": 3}, "conditions": snow}}
    simulate(parse(SimulationConfig, values, "test"), "tls", tmp_path / "run")
    added = [float(np.nanmin(read_geotiff(tmp_path / f"run/difference_{epoch:03d}.tif")[0])) for epoch in (1, 2)]
    assert added[0] < -0.03
    assert added[1] > added[0] / 2
