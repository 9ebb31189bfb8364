"""A real cliff of many touching parts in three states: a rock of 14.9 m3 in place, leaning out, fallen (AImon, MIT licence).

The expected values come from Open3D, which traces the same rays on the files' triangles.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.api.building import difference, observe, open_wall, reconstruct, stage
from scene.geometry.mesh import FloatArray
from sensors.signal_chain.observation import Observation

DATA = Path(__file__).parents[3] / "shared" / "data" / "trier_cliff"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data are not here")
STEP_RAD, GSD_M = 2.618e-4, 0.1
ROCK_M3, CHANGED_M = 14.9, 0.05


@pytest.fixture(scope="module")
def seen() -> dict[str, Observation]:
    """What a scanner without noise sees of the rock and its deposits, from the position in the data's README."""
    keys = {
        "station": {"position_m": [26.5, -240.015, 135.411], "rotation": np.eye(3).tolist()},
        "scanner": {
            "azimuth_step_rad": STEP_RAD,
            "zenith_step_rad": STEP_RAD,
            "azimuth_rad": [1.45, 1.52],
            "zenith_rad": [1.44, 1.54],
        },
        "frame__normal": "sensor",
        "model": {"sensor": "tls", "noise": {"range_sigma_m": 0.0, "angle_sigma_rad": 0.0}},
    }
    walls = {state: open_wall(DATA / f"{state}.ply") for state in ("before", "toppled", "fallen")}
    site = stage(walls["before"], "tls", **keys)
    return {
        state: observe(wall.with_vertices(site.frame.to_wall(wall.vertices)), site.sensor) for state, wall in walls.items()
    } | {"frame": site.frame}  # type: ignore[dict-item]


def _true_ranges(state: str, origin: FloatArray, rays: FloatArray) -> FloatArray:
    import open3d

    mesh = trimesh.load(DATA / f"{state}.ply", process=False)
    scene = open3d.t.geometry.RaycastingScene()
    vertices = (np.asarray(mesh.vertices) - origin).astype(np.float32)
    scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(np.asarray(mesh.faces, np.uint32)))
    start = np.zeros_like(rays)
    return scene.cast_rays(open3d.core.Tensor(np.hstack([start, rays]).astype(np.float32)))["t_hit"].numpy().astype(np.float64)


@pytest.mark.parametrize("state", ["before", "toppled", "fallen"])
def test_every_pulse_returns_from_where_the_triangles_are(seen: dict[str, Observation], state: str) -> None:
    look, frame = seen[state], seen["frame"]
    origin = frame.to_world(look.viewpoint)
    points = frame.to_world(look.points[look.valid])
    distance = np.linalg.norm(points - origin, axis=1)
    true = _true_ranges(state, origin, (points - origin) / distance[:, None])
    error = np.abs(distance - true)
    assert np.mean(error < 0.002) > 0.999  # Open3D traces in single precision; single rays along edges differ
    assert look.valid.mean() > 0.99


def test_the_rock_that_fell_is_lost_as_a_whole(seen: dict[str, Observation]) -> None:
    surfaces = {state: reconstruct(seen[state]) for state in ("before", "toppled", "fallen")}
    change = {state: difference(surfaces["before"], surfaces[state], GSD_M).values for state in ("toppled", "fallen")}
    lost, gained = (float(np.nansum(change["fallen"][sign * change["fallen"] > CHANGED_M]) * GSD_M**2) for sign in (1, -1))
    assert lost == pytest.approx(ROCK_M3, rel=0.1)
    assert -gained == pytest.approx(31.1, rel=0.15)  # the deposits in sight, by finer rays with Open3D
    leaning = change["toppled"][change["toppled"] < -0.1]
    assert np.median(leaning) == pytest.approx(-0.31, abs=0.02)
    assert leaning.sum() * GSD_M**2 == pytest.approx(-4.44, rel=0.05)
    assert np.nansum(change["toppled"] > CHANGED_M) < 5
