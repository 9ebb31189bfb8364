"""Define the triangle mesh that walls, blocks and reconstructed surfaces share, and functions of triangles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scene.common.threads import map_in_threads

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

WALL = 0
"""Block label of a face or point that belongs to no block. Labels of blocks count from 1."""

DEFAULT_ALBEDO = 0.5
"""Albedo of rock for which none is given."""

_CHUNK = 1 << 18
"""Number of faces processed at a time, to limit the memory of intermediate arrays."""
_CACHED = 1 << 14
"""Number of faces whose corners stay in the processor's cache while they are processed."""


def area_normals(corners: FloatArray) -> FloatArray:
    """Return the normals (n, 3) of n triangles, as long as twice the triangle's area, for means that are weighted by area.

    corners: (n, 3, 3) array with the three corners of each triangle, counter-clockwise seen from the side of the normal.
    """
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def signed_volumes(corners: FloatArray) -> FloatArray:
    """Return six times the signed volumes (n,) of the tetrahedra from the origin to triangles with corners (n, 3, 3).

    Their sum over a closed mesh is six times its volume. A volume is positive if the triangle's normal points away from the
    origin.
    """
    return np.asarray(np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))


def barycentric(point: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the barycentric weights (n, 3) of points in triangles, to interpolate values given at the triangles' corners.

    point: (n, 3), one in the plane of each triangle. corners: (n, 3, 3).
    """
    one, other, within = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], point - corners[:, 0]
    a, b, c = (np.einsum("ni,ni->n", *pair) for pair in ((one, one), (one, other), (other, other)))
    d, e = (np.einsum("ni,ni->n", within, side) for side in (one, other))
    area = np.maximum(a * c - b * b, 1e-300)
    second, third = (c * d - b * e) / area, (a * e - b * d) / area
    return np.stack([1 - second - third, second, third], axis=1)


def compact_vertices(faces: NDArray[np.integer]) -> tuple[NDArray[np.int64], IntArray]:
    """Find the vertices that some faces (m, 3) use, and renumber the faces accordingly, to make a mesh of part of another.

    Returns the used vertices (k,) in ascending order, and the faces (m, 3) as positions in that list.
    """
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
    """A mesh of triangles with shared vertices, counter-clockwise seen from outside (for a wall: from the sensors' side).

    Attributes
    ----------
    vertices : (n, 3) float64 array
        Coordinates, m.
    faces : (m, 3) int32 array
        Vertex indices.
    vertex_albedo : (n,) float32 array, optional
        Albedo in [0, 1].
    vertex_block, face_block : (n,) and (m,) int32 arrays, optional
        Label of the fallen block whose removal created this vertex or face; WALL (0) elsewhere.
    """

    vertices: FloatArray
    faces: IntArray
    vertex_albedo: NDArray[np.float32] | None = None
    vertex_block: IntArray | None = None
    face_block: IntArray | None = None

    @property
    def bounds(self) -> FloatArray:
        """(2, 3) smallest and largest coordinates of the mesh's vertices, m."""
        return np.array([[column.min() for column in self.vertices.T], [column.max() for column in self.vertices.T]])

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """Return an integer (3 m,) for each side of the m triangles, to find sides that triangles share.

        Sides between the same two vertices have the same integer in either direction. Sides 0-1 (between a triangle's corners 0
        and 1) of all triangles come first, then 1-2, then 2-0.
        """
        start, stop = self.faces.T.ravel(), self.faces[:, [1, 2, 0]].T.ravel()
        return np.minimum(start, stop).astype(np.int64) * len(self.vertices) + np.maximum(start, stop)

    @cached_property
    def edge_order(self) -> NDArray[np.int64]:
        """(3 m,) indices that sort the integers of the triangles' sides (`edges`), so that shared sides follow one another.

        Equal integers keep their order.
        """
        return np.argsort(self.edges, kind="stable")

    @cached_property
    def shared_edges(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The k edges that exactly two triangles share, to find neighbouring triangles: positions of their two sides in `edges`.

        Each array (k,) holds one side of every edge. Position p is a side of triangle p modulo m, the number of triangles.
        """
        order, ordered = self.edge_order, self.edges[self.edge_order]
        again = np.concatenate([[False], ordered[1:] == ordered[:-1], [False]])
        twin = np.flatnonzero(again[1:-1] & ~again[:-2] & ~again[2:])
        return order[twin], order[twin + 1]

    def with_vertices(self, vertices: FloatArray) -> TriangleMesh:
        """Return a mesh with the same triangles and labels, but with vertices moved to new positions (n, 3), m."""
        return replace(self, vertices=vertices)

    def submesh(self, faces: NDArray[np.integer] | NDArray[np.bool_] | slice = slice(None)) -> TriangleMesh:
        """Return a mesh of some of the faces, or all of them, with only the vertices that they use.

        faces: numbers (k,) of the faces, a mask (m,) or a slice.
        """
        used, numbered = compact_vertices(self.faces[faces])
        return TriangleMesh(
            self.vertices[used],
            numbered,
            None if self.vertex_albedo is None else self.vertex_albedo[used],
            None if self.vertex_block is None else self.vertex_block[used],
            None if self.face_block is None else self.face_block[faces],
        )

    def corners(self, faces: NDArray[np.integer] | slice = slice(None)) -> FloatArray:
        """Return the coordinates (k, 3, 3), m, of the three corners of some of the faces, or of all.

        faces: numbers (k,) of the faces, or a slice.
        """
        return self.vertices[self.faces[faces]]

    def area_normals(self) -> FloatArray:
        """Return the normals (m, 3) of all faces, as long as twice the face's area, for means that are weighted by area."""
        found = np.empty((len(self.faces), 3))

        def fill(start: int) -> None:
            part = slice(start, start + _CACHED)
            found[part] = area_normals(self.corners(part))

        map_in_threads(fill, range(0, len(found), _CACHED))
        return found

    def face_normals(self, faces: NDArray[np.integer] | slice = slice(None)) -> FloatArray:
        """Return the unit normals (k, 3) of some of the faces, or of all; zero for a face without area.

        faces: numbers (k,) of the faces, or a slice.
        """
        normal = area_normals(self.corners(faces))
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)

    @cached_property
    def normals(self) -> FloatArray:
        """(m, 3) unit normals of all faces, computed once and then kept."""
        return self.face_normals()

    def vertex_normals(self) -> FloatArray:
        """Return outward unit normals (n, 3) at the n vertices: the area-weighted mean of the adjacent faces' normals.

        A vertex that no face uses has NaN. They are computed once and then kept.
        """
        return self._vertex_normals

    @cached_property
    def _vertex_normals(self) -> FloatArray:
        total = np.zeros((3, len(self.vertices)))
        for start in range(0, len(self.faces), _CHUNK):
            faces = self.faces[start : start + _CHUNK]
            first, second, third = (self.vertices[faces[:, corner]] for corner in range(3))
            area = np.repeat(np.cross(second - first, third - first).T, 3, axis=1)
            low = int(faces.min())  # consecutive faces mostly use vertices with neighbouring numbers
            part = slice(low, int(faces.max()) + 1)
            for axis in range(3):
                total[axis, part] += np.bincount(faces.ravel() - low, area[axis], part.stop - low)
        with np.errstate(invalid="ignore"):
            return (total / np.linalg.norm(total, axis=0)).T
