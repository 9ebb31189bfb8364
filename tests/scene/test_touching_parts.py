"""Scenes with touching parts: rock is opaque from both sides, and nothing is lost where a rock stands on the ground."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from pipeline.api.building import observe, stage
from scene.common.errors import InputError
from scene.geometry.frame import FrameConfig
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.meshes.cleaning import clean
from scene.meshes.winding import orient_to_sensors
from scene.ray_casting.raycast import RayCaster

EYE = np.array([0.0, 0.0, 20.0])
SIDE_M, WALL_M = 2.0, 8.0


def _wall_with_cube(inside_out: bool) -> TriangleMesh:
    """Return a square wall in the plane z = 0 with a cube that stands on it and shares the four edges of its foot."""
    steps = np.arange(-WALL_M, WALL_M + 1)
    x, y = np.meshgrid(steps, steps)
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, 1:].ravel(), corner[1:, :-1].ravel()
    cube = trimesh.creation.box(extents=[SIDE_M] * 3).subdivide()
    faces = np.asarray(cube.faces)[:, ::-1] if inside_out else np.asarray(cube.faces)
    vertices = np.concatenate([ground, np.asarray(cube.vertices) + np.array([0, 0, SIDE_M / 2])])
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d]), faces + len(ground)])
    return TriangleMesh(vertices, triangles.astype(np.int32))


def _distances(rays: FloatArray) -> FloatArray:
    """Return the distance (n,) to the wall with the cube along unit vectors from EYE, in closed form (slabs of the cube; the
    plane).
    """
    with np.errstate(divide="ignore"):
        low, high = ((np.array(bound) - EYE) / rays for bound in ([-1, -1, 0], [1, 1, 2]))
    enters, leaves = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    return np.where(enters < leaves, enters, -EYE[2] / rays[:, 2])


@pytest.mark.parametrize("inside_out", [False, True])
def test_rays_meet_a_rock_that_stands_on_the_wall_however_it_is_wound(inside_out: bool) -> None:
    mesh, repairs = clean(_wall_with_cube(inside_out), "scene")
    assert len(mesh.faces) == 2 * int(2 * WALL_M) ** 2 + 48
    assert any("kept apart" in words for words in repairs)
    mesh = orient_to_sensors(mesh, [EYE], "scene", cleaned=True)[0]
    random = np.random.default_rng(5)
    target = np.column_stack([random.uniform(-6, 6, (5000, 2)), np.zeros(5000)])
    rays = (target - EYE) / np.linalg.norm(target - EYE, axis=1)[:, None]
    distance, _ = RayCaster(mesh).cast(np.broadcast_to(EYE, rays.shape), rays)
    np.testing.assert_allclose(distance, _distances(rays), atol=1e-9)


@pytest.mark.parametrize("sensor", ["tls", "stereo"])
def test_both_sensors_see_faces_that_are_wound_away_from_them(sensor: str) -> None:
    """Every second triangle of a plane is reversed, as on imported walls: each gives the same range."""
    corner = np.array([[x, 0.0, z] for z in range(5) for x in range(7)], dtype=np.float64)
    cells = np.array([(7 * row + column) for row in range(4) for column in range(6)])
    faces = np.concatenate([np.column_stack([cells, cells + 1, cells + 8]), np.column_stack([cells, cells + 8, cells + 7])])
    keys = {"station__distance_m": 15, "scanner__azimuth_step_rad": 0.004, "scanner__zenith_step_rad": 0.004}
    keys |= {"cameras__distance_m": 15.0, "cameras__base_m": 3.0, "depth_map": "low"}
    site = stage(TriangleMesh(corner, faces.astype(np.int32)), sensor, model={"sensor": sensor}, **keys)
    turned = faces.copy()
    turned[::2] = turned[::2, ::-1]
    mesh = TriangleMesh(site.mesh.vertices, turned.astype(np.int32))
    right, seen = observe(site.mesh, site.sensor), observe(mesh, site.sensor)
    assert right.valid.sum() > 500
    np.testing.assert_array_equal(seen.valid, right.valid)
    np.testing.assert_allclose(seen.points[seen.valid], right.points[right.valid], atol=1e-6)


def test_a_sensor_inside_a_closed_solid_is_an_error() -> None:
    ball = trimesh.creation.icosphere(3, radius=30.0)
    mesh = TriangleMesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32))
    with pytest.raises(InputError, match="stands inside a closed solid"):
        orient_to_sensors(mesh, [np.array([1.0, 2.0, 3.0])], "ball")
    assert orient_to_sensors(mesh, [np.array([0.0, 0.0, 60.0])], "ball")[1] == ""


def test_the_frame_can_look_along_the_line_of_sight() -> None:
    vertices = _wall_with_cube(False).vertices
    towards = np.array([30.0, -40.0, 60.0])
    middle = vertices.min(axis=0) / 2 + vertices.max(axis=0) / 2
    sight = (towards - middle) / np.linalg.norm(towards - middle)
    np.testing.assert_allclose(FrameConfig(normal="sensor").fit(vertices, towards).rotation[2], sight, atol=1e-12)
    given = FrameConfig(normal=(0.0, -3.0, 4.0)).fit(vertices, towards)
    np.testing.assert_allclose(given.rotation[2], [0.0, -0.6, 0.8], atol=1e-12)
    np.testing.assert_allclose(given.rotation @ given.rotation.T, np.eye(3), atol=1e-12)
    for wrong in ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0)):
        with pytest.raises(InputError, match=r"frame\.normal"):
            FrameConfig(normal=wrong).fit(vertices, towards)
