"""The Python interface's building blocks applied to arrays, and the user-defined sensor from docs/howto/add_sensor.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from surfaces import heightfield, plane, step

from pipeline import (
    Mesh,
    carve,
    difference,
    make_blocks,
    make_wall,
    observe,
    open_wall,
    place_blocks,
    reconstruct,
    register,
    stage,
)
from scene import InputError, RayCaster, TriangleMesh

ROOT = Path(__file__).parents[2]
COARSE: dict[str, Any] = {"station__distance_m": 12.0, "scanner__azimuth_step_rad": 0.004, "scanner__zenith_step_rad": 0.004}


def own_sensor() -> dict[str, Any]:
    """The names that the Python block of docs/howto/add_sensor.md defines."""
    text = (ROOT / "docs" / "howto" / "add_sensor.md").read_text()
    code = next(block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "class FlashLidar" in block)
    body = code[code.index("@dataclass") :]
    assert len([line for line in body.splitlines() if line.strip()]) <= 30
    namespace: dict[str, Any] = {"__name__": "own"}
    exec(compile(code, "sensor.md", "exec", dont_inherit=True), namespace)
    return namespace


def test_given_blocks_take_their_volume_out_of_a_plane() -> None:
    """Cubes that lie half in the rock of a flat wall remove half of their volume, and so does a rotated cube."""
    wall = heightfield(8.0, 6.0, 0.25, roughness=0.0)
    blocks = make_blocks([[2, 3, 0], [5, 3, 0]], [0.8, 0.5], rotations_rad=[[0, 0, 0], [0, 0, 0.7]])
    found = carve(wall, blocks)
    assert found.removed_volume_m3 == pytest.approx([0.8**3 / 2, 0.5**3 / 2], rel=1e-9)
    change = difference(wall, found.mesh, 0.05)
    inside = change.where(change.block == 1)
    assert float(inside.max()) == pytest.approx(0.4, abs=1e-6)
    assert float(inside.count()) * 0.05**2 == pytest.approx(0.64, rel=0.1)
    assert float(change.where(change.block == 0).max()) == pytest.approx(0.0, abs=1e-6)


def test_a_wall_of_arrays_is_scanned_meshed_registered_and_compared(tmp_path: Path) -> None:
    wall = make_wall(style="pilkington", width_m=5.0, height_m=4.0, resolution_m=0.1)
    again = open_wall(wall.save(tmp_path / "wall.ply"))
    assert np.allclose(again.bounds, wall.bounds)
    setup = stage(wall, "tls", **COARSE)
    assert np.allclose(setup.frame.to_world(setup.mesh.vertices), wall.vertices, atol=1e-9)
    before = reconstruct(observe(setup.mesh, setup.sensor, seed=1))
    fallen = carve(setup.mesh, place_blocks(setup.mesh, seed=2, count=2, safe_zone_offset_m=0.3))
    after = reconstruct(observe(fallen.mesh, setup.sensor, seed=2))
    found = register(after, before)
    assert np.linalg.norm(found.translation) < 0.005
    change = difference(before, after.with_vertices(found.apply(after.vertices)), 0.05)
    calm = change.where(change.block == 0)
    assert abs(float(calm.median())) < 0.003
    assert float(change.where(change.block > 0).max()) > 0.05


@pytest.mark.parametrize("as_arrays", [False, True])
def test_register_finds_a_known_motion_of_meshes_and_of_arrays(as_arrays: bool) -> None:
    """Vertices that no triangle uses are ignored; the normals of an array are estimated."""
    wall = heightfield(8.0, 6.0, 0.1, roughness=0.3)
    turn, shift = (
        np.array([[np.cos(0.01), -np.sin(0.01), 0.0], [np.sin(0.01), np.cos(0.01), 0.0], [0.0, 0.0, 1.0]]),
        [0.02, -0.03, 0.04],
    )
    stray = np.array([[100.0, 100.0, 100.0], [4.0, 3.0, 5.0]])
    reference = TriangleMesh(np.concatenate([wall.vertices, stray]), wall.faces)
    moving = TriangleMesh(np.concatenate([(wall.vertices - shift) @ turn, stray]), wall.faces)
    found = register(moving.vertices[:-2], reference.vertices[:-2]) if as_arrays else register(moving, reference)
    np.testing.assert_allclose(found.rotation, turn, atol=2e-6)
    np.testing.assert_allclose(found.translation, shift, atol=2e-5)


def test_a_mesh_wound_away_from_the_sensor_is_turned() -> None:
    wall = make_wall(style="pilkington", width_m=5.0, height_m=4.0, resolution_m=0.1)
    here = stage(wall, "tls", **COARSE)
    position = here.frame.to_world(here.viewpoints["station"]).tolist()
    flipped = Mesh.from_arrays(wall.vertices, wall.faces[:, ::-1])
    setup = stage(flipped, "tls", station__position_m=position, scanner__azimuth_step_rad=0.004)
    assert setup.repairs
    assert np.mean(setup.mesh.face_normals()[:, 2]) > 0


@pytest.mark.parametrize(
    ("call", "problem"),
    [
        (lambda: make_blocks([[0, 0]], [1.0]), r"centres: the array has the shape \(1, 2\)"),
        (lambda: make_blocks([[0, 0, 0]], [-1.0]), "allowed: above 0"),
        (lambda: make_blocks([[0, 0, np.nan]], [1.0]), "NaN or infinite"),
        (lambda: make_wall(stlye="bulga"), "did you mean 'style'"),
    ],
)
def test_wrong_arrays_are_said_in_one_line(call: Any, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        call()


@pytest.mark.parametrize("distance", [15.0, 30.0])
def test_the_documented_sensor_measures_a_plane(distance: float) -> None:
    """Ranges against the closed form d / cos of a plane at right angles to its axis, noise of the size that was asked for."""
    names = own_sensor()
    lidar = names["FlashLidar"](position=np.array([0.0, 0.0, distance]), aim=np.zeros(3), sigma_m=0.01)
    wall = plane(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    seen = observe(wall, lidar, seed=1)
    tangents = lidar.rays()
    expected = distance / -tangents[..., 2]
    error = seen.depth - expected
    assert np.std(error) == pytest.approx(0.01, rel=0.05)
    assert abs(np.mean(error)) < 5 * 0.01 / np.sqrt(error.size)
    assert np.array_equal(seen.depth, observe(wall, lidar, seed=1).depth)
    assert not np.array_equal(seen.depth, observe(wall, lidar, seed=2).depth)


def test_the_documented_sensor_goes_the_whole_way() -> None:
    lidar = own_sensor()["FlashLidar"](position=np.array([0.0, 0.0, 12.0]), aim=np.zeros(3), sigma_m=0.004)
    wall = heightfield(8.0, 6.0, 0.25, roughness=0.02)
    wall = wall.with_vertices(wall.vertices - [4.0, 3.0, 0.0])
    fallen = carve(wall, make_blocks([[0.3, 0.2, 0.0]], [0.8]))
    before, after = (reconstruct(observe(mesh, lidar, seed=number)) for number, mesh in enumerate((wall, fallen.mesh)))
    change = difference(before, after, 0.05)
    assert float(change.where(change.block == 1).median()) == pytest.approx(0.4, abs=0.05)
    assert set(np.unique(change.block)) == {0, 1}


def test_the_documented_sensor_sees_nothing_beside_the_wall() -> None:
    lidar = own_sensor()["FlashLidar"](position=np.array([0.0, 0.0, 5.0]), aim=np.array([0.0, 0.0, 9.0]))
    seen = lidar.observe(RayCaster(step(0.0, -1.0)), _random())
    assert not seen.valid.any()


def _random() -> Any:
    from scene import KeyedRandom

    return KeyedRandom(1)


def test_meshes_are_triangle_meshes() -> None:
    assert issubclass(Mesh, TriangleMesh)
