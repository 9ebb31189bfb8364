"""The triangle mesh that walls, blocks and reconstructed surfaces share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

WALL = 0
"""The block label of a face or a point that belongs to no block; blocks count from 1."""


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
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def with_vertices(self, vertices: FloatArray) -> TriangleMesh:
        """The same triangles over moved vertices."""
        return replace(self, vertices=vertices)
