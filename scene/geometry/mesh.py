"""The triangle mesh that walls, blocks and reconstructed surfaces share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

WALL = 0
"""The block label of a face or a point that belongs to no block; blocks count from 1."""

DEFAULT_ALBEDO = 0.5
"""Of rock whose albedo nobody gives."""

_CHUNK = 1 << 18
"""Faces worked on at a time, which bounds the memory of intermediates."""


def area_normals(corners: FloatArray) -> FloatArray:
    """(n, 3) normals of triangles by their corners (n, 3, 3), twice as long as their areas."""
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def signed_volumes(corners: FloatArray) -> FloatArray:
    """(n,) six times the volumes of the tetrahedra from the origin to triangles of corners (n, 3, 3); positive where its normal
    points away from there."""
    return np.asarray(np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))


def barycentric(point: FloatArray, corners: FloatArray) -> FloatArray:
    """(n, 3) weights of the corners at points (n, 3) in triangles (n, 3 corners, 3)."""
    one, other, within = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], point - corners[:, 0]
    a, b, c = (np.einsum("ni,ni->n", *pair) for pair in ((one, one), (one, other), (other, other)))
    d, e = (np.einsum("ni,ni->n", within, side) for side in (one, other))
    area = np.maximum(a * c - b * b, 1e-300)
    second, third = (c * d - b * e) / area, (a * e - b * d) / area
    return np.stack([1 - second - third, second, third], axis=1)


def renumbered(faces: NDArray[np.integer]) -> tuple[NDArray[np.int64], IntArray]:
    """(k,) the vertices that faces (m, 3) use, in rising order, and the faces by their places among these."""
    if not len(faces):
        return np.empty(0, dtype=np.int64), np.empty((0, 3), dtype=np.int32)
    low, high = int(faces.min()), int(faces.max())
    used = np.zeros(high + 1 - low, dtype=bool)
    for start in range(0, len(faces), _CHUNK):
        used[faces[start : start + _CHUNK].ravel() - low] = True
    place = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return np.flatnonzero(used) + low, place[faces - low if low else faces]


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles with shared vertices, counter-clockwise seen from outside (from the sensors' side of a wall).

    vertices: (n, 3) float64, m; faces: (m, 3) int32, vertex indices; vertex_albedo: (n,) float32 in [0, 1];
    vertex_block, face_block: (n,), (m,) int32, the block whose removal made this vertex or face, WALL (0) elsewhere.
    """

    vertices: FloatArray
    faces: IntArray
    vertex_albedo: NDArray[np.float32] | None = None
    vertex_block: IntArray | None = None
    face_block: IntArray | None = None

    @property
    def bounds(self) -> FloatArray:
        """(2, 3) smallest and largest coordinates, m."""
        return np.array([[column.min() for column in self.vertices.T], [column.max() for column in self.vertices.T]])

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """(3 m,) a number per edge, the same for both directions: edges 01 of all triangles, then 12, then 20."""
        start, stop = self.faces.T.ravel(), self.faces[:, [1, 2, 0]].T.ravel()
        return np.minimum(start, stop).astype(np.int64) * len(self.vertices) + np.maximum(start, stop)

    @cached_property
    def edge_order(self) -> NDArray[np.int64]:
        """(3 m,) what sorts `edges`, those alike in their order."""
        return np.argsort(self.edges, kind="stable")

    def with_vertices(self, vertices: FloatArray) -> TriangleMesh:
        """The same triangles over moved vertices."""
        return replace(self, vertices=vertices)

    def submesh(self, faces: NDArray[np.integer] | NDArray[np.bool_] | slice = slice(None)) -> TriangleMesh:
        """Some of the faces, or all, on the vertices that they use."""
        used, numbered = renumbered(self.faces[faces])
        return TriangleMesh(
            self.vertices[used],
            numbered,
            None if self.vertex_albedo is None else self.vertex_albedo[used],
            None if self.vertex_block is None else self.vertex_block[used],
            None if self.face_block is None else self.face_block[faces],
        )

    def corners(self, faces: NDArray[np.integer] | slice = slice(None)) -> FloatArray:
        """(k, 3, 3) corners of some faces, or of all."""
        return self.vertices[self.faces[faces]]

    def face_normals(self, faces: NDArray[np.integer] | slice = slice(None)) -> FloatArray:
        """(k, 3) unit normals of some faces, or of all; 0 for a face without an area."""
        normal = area_normals(self.corners(faces))
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)

    @cached_property
    def normals(self) -> FloatArray:
        """(m, 3) `face_normals` of all faces, kept: for meshes of which many rays meet every face, again and again."""
        return self.face_normals()

    def vertex_normals(self) -> FloatArray:
        """(n, 3) unit normals, outside: the sum of the adjacent faces' normals weighted by area; NaN for an unused vertex."""
        total = np.zeros((3, len(self.vertices)))
        for start in range(0, len(self.faces), _CHUNK):
            faces = self.faces[start : start + _CHUNK]
            first, second, third = (self.vertices[faces[:, corner]] for corner in range(3))
            area = np.repeat(np.cross(second - first, third - first).T, 3, axis=1)
            low = int(faces.min())  # faces near one another in memory share vertices that are
            part = slice(low, int(faces.max()) + 1)
            for axis in range(3):
                total[axis, part] += np.bincount(faces.ravel() - low, area[axis], part.stop - low)
        with np.errstate(invalid="ignore"):
            return (total / np.linalg.norm(total, axis=0)).T
