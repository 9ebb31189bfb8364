"""Parts of a mesh with their own vertices, compared with NumPy's sorting."""

from __future__ import annotations

import numpy as np
import pytest
from surfaces import sphere

from scene.geometry.mesh import TriangleMesh, compact_vertices, signed_volumes


@pytest.mark.parametrize("seed", range(5))
def test_faces_are_numbered_by_the_vertices_that_they_use(seed: int) -> None:
    faces = np.random.default_rng(seed).integers(100, 160, (12, 3)).astype(np.int32)
    used, numbered = compact_vertices(faces)
    expected, inverse = np.unique(faces, return_inverse=True)
    np.testing.assert_array_equal(used, expected)
    np.testing.assert_array_equal(numbered, inverse.reshape(-1, 3))
    assert numbered.dtype == np.int32


def test_no_faces_use_no_vertices() -> None:
    used, numbered = compact_vertices(np.empty((0, 3), dtype=np.int32))
    assert len(used) == 0
    assert numbered.shape == (0, 3)


def test_a_submesh_keeps_places_and_channels() -> None:
    whole = sphere(np.zeros(3), 2.0, 4)
    count = len(whole.vertices)
    mesh = TriangleMesh(
        whole.vertices, whole.faces, np.linspace(0, 1, count, dtype=np.float32), np.arange(count, dtype=np.int32),
        np.arange(len(whole.faces), dtype=np.int32),
    )  # fmt: skip
    chosen = np.arange(len(mesh.faces)) % 7 == 0
    part = mesh.submesh(chosen)
    np.testing.assert_array_equal(part.corners(), mesh.corners(np.flatnonzero(chosen)))
    assert part.vertex_block is not None
    assert part.vertex_albedo is not None
    assert mesh.vertex_albedo is not None
    np.testing.assert_array_equal(part.vertices, mesh.vertices[part.vertex_block])
    np.testing.assert_array_equal(part.vertex_albedo, mesh.vertex_albedo[part.vertex_block])
    np.testing.assert_array_equal(part.face_block, np.flatnonzero(chosen))
    assert len(part.vertices) == len(np.unique(part.faces))


def test_tetrahedra_of_a_sphere_sum_to_its_volume() -> None:
    """The sign is positive outwards, for any point inside: 4/3 pi r^3 less what the facets cut off."""
    mesh = sphere(np.zeros(3), 2.0, 4)
    for origin in (np.zeros(3), np.array([0.3, -0.2, 0.5])):
        assert signed_volumes(mesh.corners() - origin).sum() / 6 == pytest.approx(4 / 3 * np.pi * 8, rel=0.05)
