"""Normals of planes through neighbouring points: where triangles lean by the noise and the relief between their corners."""

from __future__ import annotations

import numpy as np

from scene.mesh import FloatArray

_NEIGHBOURS = 24
_AT_ONCE = 100_000


def plane_normals(points: FloatArray) -> FloatArray:
    """(n, 3) unit normals, either way round, of the planes of least squares through each point's 24 nearest, itself among them.

    The least eigenvector of their scatter (Hoppe et al. 1992, Surface reconstruction from unorganized points).
    """
    from scipy.spatial import cKDTree

    tree, count = cKDTree(points), min(_NEIGHBOURS, len(points))
    normals = np.empty_like(points)
    for first in range(0, len(points), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        near = points[tree.query(points[rows], count, workers=-1)[1]]
        near -= near.mean(axis=1, keepdims=True)
        normals[rows] = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    return normals
