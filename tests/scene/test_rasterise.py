"""Drawing a mesh on a raster gives what rays cast straight down give."""

from __future__ import annotations

import numpy as np
import pytest

from scene.common.backend import mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.rasterise import FlatMesh
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device
from scene.walls.procedural import ProceduralWall


def sheet(height: float = 0.0, side_m: float = 1.0) -> TriangleMesh:
    """Two triangles on the plane z = height + 0.2 x - 0.1 y."""
    corners = np.array([[0, 0], [side_m, 0], [side_m, side_m], [0, side_m]], dtype=np.float64)
    z = height + corners @ [0.2, -0.1]
    return TriangleMesh(np.column_stack([corners, z]), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def test_heights_on_a_plane_are_exact_and_no_pixel_on_the_diagonal_is_missing() -> None:
    grid = Grid(0.0, 1.0, 0.1, 10, 10)
    top = FlatMesh(sheet(), grid).top_faces()
    assert np.array(top.valid).all()
    x, y, z = (np.array(each) for each in top.point)
    np.testing.assert_allclose(z, 0.2 * x - 0.1 * y, atol=1e-14)
    np.testing.assert_array_equal(x.reshape(10, 10)[0], (np.arange(10) + 0.5) * 0.1)


def test_the_upper_of_two_sheets_is_kept_and_what_lies_outside_the_mesh_is_empty() -> None:
    low, high = sheet(0.0, 1.0), sheet(0.5, 0.5)
    both = TriangleMesh(
        np.concatenate([low.vertices, high.vertices]), np.concatenate([low.faces, high.faces + 4]).astype(np.int32)
    )
    grid = Grid(-0.2, 1.0, 0.1, 14, 10)
    top = FlatMesh(both, grid).top_faces()
    valid, face = np.array(top.valid).reshape(grid.shape), np.array(top.face).reshape(grid.shape)
    assert not valid[:, :2].any()
    assert not valid[:, 12:].any()
    assert (face[5:, 2:7] >= 2).all()
    assert (face[:5, 2:12] < 2).all()


def test_a_rough_wall_has_the_faces_and_labels_that_rays_meet() -> None:
    """Single precision takes another face on up to one pixel in 10,000, where a centre lies on an edge."""
    mesh = ProceduralWall(style="bulga", width_m=12.0, height_m=8.0, resolution_m=0.05).mesh(KeyedRandom(1))
    grid = Grid(float(mesh.bounds[0, 0]), float(mesh.bounds[1, 1]), 0.03, 390, 260)
    flat, caster = FlatMesh(mesh, grid), RayCaster(mesh)
    assert flat.is_quick
    top, (hits, point) = flat.top_faces(), caster.look_down(grid)
    valid = np.array(hits.valid)
    np.testing.assert_array_equal(np.array(top.valid), valid)
    other = np.abs(np.array(top.point.z) - np.array(point.z))[valid] > 1e-9
    assert other.mean() < 1e-4
    labels = on_device(mi.Int32, np.arange(len(mesh.vertices), dtype=np.int32) % 7)
    differ = np.array(flat.labels(top, labels)) != np.array(caster.nearest_vertex_label(hits, point, labels))
    assert differ.mean() < 1e-4


def test_large_faces_are_left_to_rays() -> None:
    assert not FlatMesh(sheet(), Grid(0.0, 1.0, 0.01, 100, 100)).is_quick


def test_a_mesh_without_faces_is_refused() -> None:
    empty = TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int32))
    with pytest.raises(InputError, match="no triangles"):
        FlatMesh(empty, Grid(0.0, 1.0, 0.1, 10, 10))
