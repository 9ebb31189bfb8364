"""Events found in a run's maps have survey coordinates, of the rock before it fell."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from pipeline.detection.products.events import Event, read_events, write_events
from pipeline.detection.products.places import with_world_coordinates
from pipeline.formats.files.atomic import write_json
from pipeline.formats.meshes.ply import write_ply
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import TriangleMesh

ORIGIN = np.array([345200.0, 6389450.0, 120.0])
EVENT = Event("difference_001.tif", 1, 3.0, 2.0, 0.4, 0.2, 0.08, 0.3, 0.2, 0.016, 0.97)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A wall in survey coordinates whose reference is the plane z = 0.1 x."""
    turn = np.deg2rad(30)
    rotation = np.array([[np.cos(turn), np.sin(turn), 0.0], [0.0, 0.0, 1.0], [np.sin(turn), -np.cos(turn), 0.0]])
    matrix = WallFrame(rotation, ORIGIN).matrix
    frame = {"matrix_world_to_wall": matrix.tolist(), "rotation": rotation.tolist(), "origin_m": ORIGIN.tolist()}
    write_json(tmp_path / "run.json", {"sensor": "tls", "config": {}, "wall": {"name": "w"}, "wall_frame": frame})
    x, y = (part.ravel() for part in np.meshgrid(np.arange(0, 6, 0.04), np.arange(0, 4, 0.04)))
    vertices = np.stack([x, y, 0.1 * x], axis=1)
    write_ply(tmp_path / "epoch_000/surface.ply", TriangleMesh(vertices, np.array([[0, 1, 200]], dtype=np.int32)))
    return tmp_path


def test_an_event_lies_on_the_rock_before_it_fell(run: Path) -> None:
    found = with_world_coordinates(EVENT, run / "difference_001.tif")
    frame = WallFrame(np.array([[0.75**0.5, 0.5, 0], [0, 0, 1], [0.5, -(0.75**0.5), 0]]), ORIGIN)
    expected = frame.to_world(np.array([3.0, 2.0, 0.3]))
    np.testing.assert_allclose([found.world_x_m, found.world_y_m, found.world_z_m], expected, atol=0.005)
    assert with_world_coordinates(EVENT, run / "tiles" / "a.tif") == found
    write_events([found], run / "events.csv")
    (again,) = read_events(run / "events.csv")
    assert again.world_y_m == pytest.approx(found.world_y_m, abs=1e-4)


def test_a_place_that_is_not_known_stays_empty(run: Path, tmp_path: Path) -> None:
    (run / "epoch_000/surface.ply").unlink()
    for event in (
        with_world_coordinates(EVENT, run / "other" / "difference_001.tif"),
        with_world_coordinates(EVENT, tmp_path / "x" / "y" / "map.tif"),
    ):
        assert np.isnan([event.world_x_m, event.world_y_m, event.world_z_m]).all()
    write_events([EVENT], tmp_path / "events.csv")
    assert (tmp_path / "events.csv").read_text().splitlines()[1].endswith(",0.9700,,,")
    (again,) = read_events(tmp_path / "events.csv")
    assert {key: value for key, value in asdict(again).items() if value == value} == {
        key: value for key, value in asdict(EVENT).items() if value == value
    }
