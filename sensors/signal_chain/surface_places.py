"""Places on a surface with what an error of their recorded points may depend on, whatever sensor saw them.

Lengths are in the wall frame: x along the wall, y up it, z out of it. What a vertex's neighbourhood tells (its normal, roughness
and convexity) is that of the plane of least squares through the 24 nearest vertices, so that it belongs to a length of about
three spacings of the mesh's vertices.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray, TriangleMesh

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Covariate = Literal["along", "up", "out", "slope", "roughness", "convexity", "edge_distance"]
_NEIGHBOURS = 24
_AT_ONCE = 100_000
_CREASE = float(np.cos(np.radians(45.0)))
"""Cosine between the normals of two neighbouring vertices below which the surface has an edge between them."""


@dataclass(frozen=True)
class SurfacePlaces:
    """n places. point: (n, 3), wall frame, m; normal: (n, 3) unit, out of the rock; roughness: (n,) standard deviation of the
    neighbours from their plane, m; convexity: (n,) height above the neighbours' middle, m; edge_distance: (n,) m to the nearest
    edge of the mesh: its rim, or a crease."""

    point: FloatArray
    normal: FloatArray
    roughness: FloatArray
    convexity: FloatArray
    edge_distance: FloatArray

    def __len__(self) -> int:
        return len(self.point)

    def part(self, rows: Any) -> Self:
        """Some of the places."""
        return replace(self, **{each.name: getattr(self, each.name)[rows] for each in fields(self)})

    @property
    def covariates(self) -> dict[str, FloatArray]:
        """(n,) each: place (m), slope against the wall's plane (rad), and the rest (m)."""
        along, up, out = self.point.T
        return {
            "along": along,
            "up": up,
            "out": out,
            "slope": np.arccos(np.clip(self.normal[:, 2], -1.0, 1.0)),
            "roughness": self.roughness,
            "convexity": self.convexity,
            "edge_distance": self.edge_distance,
        }


class ShapedSurface:
    """A mesh, wall frame, with what its vertices' neighbourhoods tell."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self._normal, self._roughness, self._convexity = self._planes()

    def nearest(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
        """(n,) distance (m) and number of the vertex nearest to each of some points (n, 3)."""
        distance, number = self._tree.query(points, workers=-1)
        return distance, number.astype(np.int64)

    def normals(self, vertices: NDArray[np.int64]) -> FloatArray:
        """(n, 3) unit normals, out of the rock, at vertices (n,)."""
        return np.asarray(self._normal[vertices])

    def at(self, point: FloatArray, vertices: NDArray[np.int64]) -> SurfacePlaces:
        """Places (n, 3), m, each with the values of the mean of some vertices (n, k)."""
        normal = self._normal[vertices].mean(axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        values = (each[vertices].mean(axis=1) for each in (self._roughness, self._convexity, self._edge_distance))
        return SurfacePlaces(point, normal, *values)

    def near(self, point: FloatArray) -> SurfacePlaces:
        """Places (n, 3), m, each with the values of the nearest vertex; NaN where a point is."""
        known = np.isfinite(point).all(axis=1, keepdims=True)
        vertices = self.nearest(np.where(known, point, 0.0))[1]
        return self.at(point, vertices[:, None])

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.mesh.vertices)

    @property
    def rim(self) -> NDArray[np.int64]:
        """Numbers of the vertices at the mesh's open borders."""
        edges, uses = np.unique(self.mesh.edges, return_counts=True)
        return np.unique(np.concatenate(np.divmod(edges[uses == 1], len(self.mesh.vertices))))

    @cached_property
    def _edge_distance(self) -> FloatArray:
        """(v,) m; as large as the mesh where it has no edge."""
        from scipy.spatial import cKDTree

        first, second = np.divmod(self.mesh.edges, len(self.mesh.vertices))
        creased = np.einsum("ni,ni->n", self._normal[first], self._normal[second]) < _CREASE
        edge = np.unique(np.concatenate([self.rim, first[creased], second[creased]]))
        if not len(edge):
            return np.full(len(self.mesh.vertices), float(np.linalg.norm(np.ptp(self.mesh.bounds, axis=0))))
        return np.asarray(cKDTree(self.mesh.vertices[edge]).query(self.mesh.vertices, workers=-1)[0])

    def _planes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal (v, 3), roughness (v,) and convexity (v,) at the vertices."""
        vertices, outwards = self.mesh.vertices, self.mesh.vertex_normals()
        count = min(_NEIGHBOURS, len(vertices))
        normal = np.empty_like(outwards)
        roughness, convexity = np.empty(len(vertices)), np.empty(len(vertices))
        for start in range(0, len(vertices), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            near = vertices[self._tree.query(vertices[rows], count, workers=-1)[1]]
            middle = near.mean(axis=1)
            near = near - middle[:, None]
            values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near) / count)
            found = axes[:, :, 0]
            found = found * np.where(np.einsum("ni,ni->n", found, outwards[rows]) < 0, -1.0, 1.0)[:, None]
            normal[rows], roughness[rows] = found, np.sqrt(np.maximum(values[:, 0], 0.0))
            convexity[rows] = np.einsum("ni,ni->n", vertices[rows] - middle, found)
        return normal, roughness, convexity


@dataclass(frozen=True)
class RecordedPoints:
    """Points on their way into a cloud. places: on the true surface; above: (n,) m by which each is recorded above it, along its
    normal."""

    places: SurfacePlaces
    above: FloatArray

    def raised(self, by: FloatArray) -> RecordedPoints:
        """The same with a further error (n,), m."""
        return replace(self, above=self.above + by)
