"""Divide polygons of more than three corners into triangles."""

from __future__ import annotations

import manifold3d
import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray, IntArray


def triangulated(vertices: FloatArray, polygons: NDArray[np.integer]) -> IntArray:
    """Divide polygons of equal numbers of corners into triangles, in the order of the polygons.

    A polygon is divided as a fan about its first corner if that keeps all triangles on one side, else by ear clipping in its mean
    plane.

    Parameters
    ----------
    vertices : (n, 3) array
        Coordinates, in any unit.
    polygons : (p, k) array of int
        Vertices of each polygon, in order.

    Returns
    -------
    (p (k - 2), 3) array of int
    """
    corners = polygons.shape[1]
    fan = np.stack([np.zeros(corners - 2, int), np.arange(1, corners - 1), np.arange(2, corners)], axis=1)
    triangles = polygons[:, fan]
    for place in np.flatnonzero(~fan_fills(vertices, polygons)):
        triangles[place] = polygons[place][_ear_clipped(vertices[polygons[place]])]
    return np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.int32)


def fan_fills(vertices: FloatArray, polygons: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Say of each polygon, (p,), whether the triangles of a fan about its first corner all face the polygon's own side."""
    spokes = vertices[polygons[:, 1:]] - vertices[polygons[:, :1]]
    normals = np.cross(spokes[:, :-1], spokes[:, 1:])
    return np.asarray(np.all(np.einsum("ptj,pj->pt", normals, normals.sum(axis=1)) >= 0.0, axis=1))


def _ear_clipped(corners: FloatArray) -> IntArray:
    """(k - 2, 3) corners of the triangles of one polygon, (k, 3), which Manifold divides in the plane of its mean normal."""
    spokes = corners - corners[0]
    normal = np.cross(spokes[1:-1], spokes[2:]).sum(axis=0)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    second = np.cross(normal, first)
    axes = np.stack([first / np.linalg.norm(first), second / np.linalg.norm(second)], axis=1)
    return np.asarray(manifold3d.triangulate([spokes @ axes]), dtype=np.int32)
