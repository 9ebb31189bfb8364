"""Describe places on a surface by the properties on which errors of recorded points may depend, whatever the sensor.

Lengths are in the wall frame: x along the wall, y up, z out of it. Normal, roughness and convexity of a vertex come from the
least-squares plane through the 24 nearest vertices, so they describe a length of about three vertex spacings.
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
"""Names of the properties."""
_NEIGHBOURS = 24
"""Number of vertices through which a plane is fitted."""
_AT_ONCE = 100_000
"""Number of vertices processed at a time."""
_CREASE = float(np.cos(np.radians(45.0)))
"""Cosine between the normals of two neighbouring vertices below which there is an edge between them."""


@dataclass(frozen=True)
class SurfacePlaces:
    """n places on the rock's surface, with the shape of the surface around them, on which errors of points may depend.

    Attributes
    ----------
    point : (n, 3) array
        Position, wall frame, m.
    normal : (n, 3) array
        Unit normal, pointing out of the rock.
    roughness : (n,) array
        Standard deviation of the neighbouring vertices from their plane, m.
    convexity : (n,) array
        Height above the centre of the neighbouring vertices, m; positive on convex rock.
    edge_distance : (n,) array
        Distance to the nearest edge of the mesh (its border or a crease), m.
    """

    point: FloatArray
    normal: FloatArray
    roughness: FloatArray
    convexity: FloatArray
    edge_distance: FloatArray

    def __len__(self) -> int:
        return len(self.point)

    def part(self, rows: Any) -> Self:
        """Return some of the places. rows: their numbers (k,), a mask (n,) or a slice."""
        return replace(self, **{each.name: getattr(self, each.name)[rows] for each in fields(self)})

    @property
    def covariates(self) -> dict[str, FloatArray]:
        """The quantities on which errors of points may depend, by name, (n,) each.

        `along`, `up` and `out`: position x, y, z in the wall frame, m. `slope`: angle against the wall's plane, rad. `roughness`
        and `convexity`: standard deviation of the vertices nearby from their plane, and height above their centre, m.
        `edge_distance`: distance to the nearest edge of the mesh (its border or a crease), m.
        """
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
    """A mesh in the wall frame, with the shape of the surface around each vertex: its normal, roughness and convexity."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self._normal, self._roughness, self._convexity = self._planes()

    def nearest(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
        """Find the mesh's vertex nearest to each of n points (n, 3), wall frame, m.

        Returns its distance (n,), m, and its number (n,).
        """
        distance, number = self._tree.query(points, workers=-1)
        return distance, number.astype(np.int64)

    def normals(self, vertices: NDArray[np.int64]) -> FloatArray:
        """Return the surface's unit normals (n, 3), pointing out of the rock, at vertices of the mesh given by number (n,)."""
        return np.asarray(self._normal[vertices])

    def at(self, point: FloatArray, vertices: NDArray[np.int64]) -> SurfacePlaces:
        """Describe the surface around n places by the mean properties (normal, roughness and so on) of vertices near each.

        point: (n, 3) places, wall frame, m. vertices: (n, k) numbers of the k vertices of each.
        """
        normal = self._normal[vertices].mean(axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        values = (each[vertices].mean(axis=1) for each in (self._roughness, self._convexity, self._edge_distance))
        return SurfacePlaces(point, normal, *values)

    def near(self, point: FloatArray) -> SurfacePlaces:
        """Describe the surface around n places (n, 3), wall frame, m, by normal, roughness, convexity and distance to the edge.

        These are the values of the mesh's vertex nearest to each place. A place with NaN coordinates keeps them, and the values
        given for it mean nothing.
        """
        known = np.isfinite(point).all(axis=1, keepdims=True)
        vertices = self.nearest(np.where(known, point, 0.0))[1]
        return self.at(point, vertices[:, None])

    @cached_property
    def _tree(self) -> cKDTree:
        """Search tree of the vertices."""
        from scipy.spatial import cKDTree

        return cKDTree(self.mesh.vertices)

    @property
    def rim(self) -> NDArray[np.int64]:
        """Indices (k,) of the mesh's vertices on its open borders, which are edges of the measured surface."""
        edges, uses = np.unique(self.mesh.edges, return_counts=True)
        return np.unique(np.concatenate(np.divmod(edges[uses == 1], len(self.mesh.vertices))))

    @cached_property
    def _edge_distance(self) -> FloatArray:
        """(v,) distance of each vertex to the nearest edge, m; the size of the mesh if it has no edge."""
        from scipy.spatial import cKDTree

        first, second = np.divmod(self.mesh.edges, len(self.mesh.vertices))
        creased = np.einsum("ni,ni->n", self._normal[first], self._normal[second]) < _CREASE
        edge = np.unique(np.concatenate([self.rim, first[creased], second[creased]]))
        if not len(edge):
            return np.full(len(self.mesh.vertices), float(np.linalg.norm(np.ptp(self.mesh.bounds, axis=0))))
        return np.asarray(cKDTree(self.mesh.vertices[edge]).query(self.mesh.vertices, workers=-1)[0])

    def _planes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return normal (v, 3), roughness (v,) and convexity (v,) at the vertices."""
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
    """Points of a stereo pair's point cloud while errors are added to them.

    Attributes
    ----------
    places : SurfacePlaces
        Where the n points lie on the true surface.
    above : (n,) array
        How far each is recorded above the surface, along its normal, m.
    """

    places: SurfacePlaces
    above: FloatArray

    def with_height_error(self, by: FloatArray) -> RecordedPoints:
        """Return the points with a further error (n,) along the surface's normals, m."""
        return replace(self, above=self.above + by)
