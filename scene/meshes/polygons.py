"""Divide polygons with more than three corners into triangles."""

from __future__ import annotations

import manifold3d
import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray, IntArray


def triangulate_polygons(vertices: FloatArray, polygons: NDArray[np.integer]) -> IntArray:
    """Divide polygons with equal numbers of corners into triangles, in the order of the polygons.

    A polygon is divided into a fan about its first corner if all triangles of the fan face the same side, else by ear clipping
    in its mean plane.

    Parameters
    ----------
    vertices : (n, 3) array
        Coordinates, in any unit.
    polygons : (p, k) array of int
        Vertices of each polygon, in order.

    Returns
    -------
    (p (k - 2), 3) array of int
        Vertices of the triangles.
    """
    corners = polygons.shape[1]
    fan = np.stack([np.zeros(corners - 2, int), np.arange(1, corners - 1), np.arange(2, corners)], axis=1)
    triangles = polygons[:, fan]
    for place in np.flatnonzero(~fan_is_valid(vertices, polygons)):
        triangles[place] = polygons[place][_ear_clipped(vertices[polygons[place]])]
    return np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.int32)


def fan_is_valid(vertices: FloatArray, polygons: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Find which polygons may be divided into a fan of triangles about their first corner: a bool array (p,).

    They are those for which all triangles of the fan face the polygon's own side. vertices: (n, 3) coordinates. polygons: (p,
    k) vertices of each polygon, in order.
    """
    spokes = vertices[polygons[:, 1:]] - vertices[polygons[:, :1]]
    normals = np.cross(spokes[:, :-1], spokes[:, 1:])
    return np.asarray(np.all(np.einsum("ptj,pj->pt", normals, normals.sum(axis=1)) >= 0.0, axis=1))


def _ear_clipped(corners: FloatArray) -> IntArray:
    """Triangulate one polygon with corners (k, 3) in the plane of its mean normal. Returns corner numbers (k - 2, 3)."""
    spokes = corners - corners[0]
    normal = np.cross(spokes[1:-1], spokes[2:]).sum(axis=0)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    second = np.cross(normal, first)
    axes = np.stack([first / np.linalg.norm(first), second / np.linalg.norm(second)], axis=1)
    return np.asarray(manifold3d.triangulate([spokes @ axes]), dtype=np.int32)
