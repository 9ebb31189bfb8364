"""Fit planes through neighbouring points of a cloud.

They give normals where triangles between the points would be tilted by noise and relief, and an estimate of the points' own
noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

_NEIGHBOURS = 24
_AT_ONCE = 100_000
"""Number of points processed at a time."""
_LEAST_COSINE = 0.05
"""Lower limit on the cosine of the incidence angle, which keeps distances along grazing rays finite."""
_NEAR = 8
"""Number of nearest neighbours in the inner plane of `estimate_point_noise`; the outer one has the other 16."""
_SAMPLE = 10_000
"""Number of points from which the noise is estimated."""
_AS_WHITE = 1.2
"""Largest ratio of outer to inner residuals for which independent noise counts as dominant."""


@dataclass(frozen=True)
class PointPlanes:
    """Planes fitted to a point cloud by least squares, one through the 24 nearest neighbours of each point (itself included).

    They give the surface's normals, and how rough or noisy it is.

    Attributes
    ----------
    normal : (n, 3) array
        Unit normals, of either sign.
    scatter_m : (n,) array
        Root mean square distance of the 24 points from their plane, m.
    median_scatter_m : float
        Median over the points of the scatter, measured along the rays from the viewpoint, m.
    noise_dominates : bool
        Whether the scatter is mostly independent noise of each point rather than relief.
    """

    normal: FloatArray
    scatter_m: FloatArray
    median_scatter_m: float
    noise_dominates: bool

    @classmethod
    def of(cls, points: FloatArray, viewpoint: FloatArray) -> PointPlanes:
        """Fit a plane to the 24 nearest neighbours of each point of a cloud.

        points: (n, 3), m. viewpoint: (3,) position of the sensor, m. The normal is the eigenvector of the neighbours'
        covariance with the smallest eigenvalue (Hoppe et al. 1992, Surface reconstruction from unorganized points); the scatter
        is the square root of that eigenvalue.
        """
        normal, scatter = _planes(points)
        ray = points - viewpoint
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        noise_dominates = estimate_point_noise(points, viewpoint) is not None
        return cls(normal, scatter, float(np.median(_along(ray, normal, scatter))), noise_dominates)

    def along(self, rays: FloatArray, point: NDArray[np.int32]) -> FloatArray:
        """Return the scatter (n, k), m, of points about their fitted planes, measured along rays, not normal to the planes.

        It tells how precisely rays hit the surface that the planes stand for.

        rays: (n, 3) unit vectors. point: (n, k) for each ray, the numbers of the k points whose planes it may hit.
        """
        return _along(rays[:, None], self.normal[point], self.scatter_m[point])


def estimate_normals(points: FloatArray) -> FloatArray:
    """Estimate unit normals (n, 3), of either sign, of points (n, 3) from the plane through the 24 nearest neighbours of each."""
    return _planes(points)[0]


def _planes(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the unit normals (n, 3) of the planes through each point's 24 nearest neighbours, and their scatter (n,), m."""
    from scipy.spatial import cKDTree

    tree, count = cKDTree(points), min(_NEIGHBOURS, len(points))
    normal, scatter = np.empty_like(points), np.empty(len(points))
    for first in range(0, len(points), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        near = points[tree.query(points[rows], count, workers=-1)[1]]
        near -= near.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near) / count)
        normal[rows], scatter[rows] = vectors[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0.0))
    return normal, scatter


def _along(rays: FloatArray, normal: FloatArray, scatter: FloatArray) -> FloatArray:
    """Convert scatter (...) normal to planes with normals (..., 3) into scatter along unit rays (..., 3)."""
    return np.asarray(scatter / np.maximum(np.abs(np.einsum("...i,...i->...", normal, rays)), _LEAST_COSINE))


def estimate_point_noise(points: FloatArray, viewpoint: FloatArray) -> float | None:
    """Estimate the standard deviation, m, of the independent noise of points (n, 3) along the rays from `viewpoint` (3,).

    For a sample of points, the distance of each point from two planes is compared: the plane through its 8 nearest neighbours,
    and the one through the 16 after those. Independent noise gives nearly the same residuals from both, while relief gives
    larger ones from the second. Returns None if the second are too large for noise to dominate, or if there are too few points.
    All lengths are in m.
    """
    from scipy.spatial import cKDTree

    if len(points) <= _NEIGHBOURS:
        return None
    some = points[:: max(len(points) // _SAMPLE, 1)]
    near = points[cKDTree(points, balanced_tree=False, compact_nodes=False).query(some, _NEIGHBOURS + 1)[1]]
    ray = some - viewpoint
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    inner, outer = (_off_plane(some, each, ray) for each in (near[:, 1 : _NEAR + 1], near[:, _NEAR + 1 :]))
    if not 0 < outer <= _AS_WHITE * inner:
        return None
    return inner / float(np.sqrt(1 + 1 / _NEAR))


def _off_plane(points: FloatArray, near: FloatArray, rays: FloatArray) -> float:
    """Return the robust standard deviation, m, of points from planes that are fitted to their neighbours.

    Parameters
    ----------
    points : (n, 3) array
        Points, m.
    near : (n, k, 3) array
        Neighbours of each point.
    rays : (n, 3) array
        Direction in which the distance from the plane is measured.
    """
    middle = near.mean(axis=1)
    within = near - middle[:, None]
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", within, within))[1][:, :, 0]
    facing = np.einsum("ni,ni->n", normal, rays)
    off = np.einsum("ni,ni->n", normal, points - middle) / np.where(np.abs(facing) > _LEAST_COSINE, facing, np.inf)
    return float(1.4826 * np.median(np.abs(off)))
