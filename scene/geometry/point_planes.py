"""Planes through neighbouring points: where triangles lean by the noise and the relief between their corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray

_NEIGHBOURS = 24
_AT_ONCE = 100_000
_LEAST_COSINE = 0.05
_NEAR = 8
_SAMPLE = 10_000
_AS_WHITE = 1.2
"""Times by which points may scatter more about what lies farther from them, for noise of their own to be most of it."""


@dataclass(frozen=True)
class PointPlanes:
    """Planes of least squares through each point's 24 nearest, itself among them.

    normal: (n, 3) unit, either way round; scatter_m: (n,) root mean square distance of the 24 from their plane; typical_m: median
    of the scatter along the lines from the viewpoint; of_noise: whether it is noise of each point's own for the most part.
    """

    normal: FloatArray
    scatter_m: FloatArray
    typical_m: float
    of_noise: bool

    @classmethod
    def of(cls, points: FloatArray, viewpoint: FloatArray) -> PointPlanes:
        """Of points (n, 3) seen from a place (3,), m: the least eigenvector of their scatter (Hoppe et al. 1992, Surface
        reconstruction from unorganized points) and the root of its eigenvalue."""
        normal, scatter = _planes(points)
        ray = points - viewpoint
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        of_noise = own_noise(points, viewpoint) is not None
        return cls(normal, scatter, float(np.median(_along(ray, normal, scatter))), of_noise)

    def along(self, rays: FloatArray, point: NDArray[np.int32]) -> FloatArray:
        """(n, k) scatter about the planes of some points (n, k) along unit rays (n, 3), m."""
        return _along(rays[:, None], self.normal[point], self.scatter_m[point])


def normals_of(points: FloatArray) -> FloatArray:
    """Estimate unit normals (n, 3), of either sign, of points (n, 3): of the plane through the 24 nearest of each."""
    return _planes(points)[0]


def _planes(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit normals (n, 3) of the planes through each point's 24 nearest, and the (n,) scatter of the 24 about them, m."""
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
    """(...) scatter (...) about planes with normals (..., 3) along unit rays (..., 3)."""
    return np.asarray(scatter / np.maximum(np.abs(np.einsum("...i,...i->...", normal, rays)), _LEAST_COSINE))


def own_noise(points: FloatArray, viewpoint: FloatArray) -> float | None:
    """Standard deviation, along the lines from a place (3,), of an error that each of the points (n, 3) has of its own, m; None
    where relief is more than that.

    Of each of a sample: how far it lies from the plane through its 8 nearest, and from that through the 16 after those. Noise of
    their own is the same in both but for that of the planes, relief grows with the distance.
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
    """Robust standard deviation of points (n, 3) along rays (n, 3) about the planes through others (n, k, 3)."""
    middle = near.mean(axis=1)
    within = near - middle[:, None]
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", within, within))[1][:, :, 0]
    facing = np.einsum("ni,ni->n", normal, rays)
    off = np.einsum("ni,ni->n", normal, points - middle) / np.where(np.abs(facing) > _LEAST_COSINE, facing, np.inf)
    return float(1.4826 * np.median(np.abs(off)))
