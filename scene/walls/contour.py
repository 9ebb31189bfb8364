"""Measure the relief and the median height of the wall within the contours of blocks.

A block's contour is the convex hull of its vertices, projected on the wall plane. Blocks are convex apart from their
irregularity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.geometry.under_boxes import faces_under_boxes
from scene.ray_casting.raycast import RayCaster

_SIDE = 16
"""Heights are sampled at this many positions along each axis of a contour's bounding box, and at four times as many on its
outline.
"""


def highest_under(caster: RayCaster, outlines: Sequence[FloatArray]) -> FloatArray:
    """Return the largest z (k,) of the wall within the contour of each of k blocks, m; -inf where there is no wall.

    It tells how high a block lies on the relief.

    Parameters
    ----------
    caster : RayCaster
        The wall, wall frame.
    outlines : sequence of (n, 2) arrays
        For each block, points (x, y), wall frame, m, whose convex hull is its contour.
    """
    hulls = [_Hull(points) for points in outlines]
    tops = np.array([values.max(initial=-np.inf) for values in _heights(caster, hulls)])
    return np.maximum(tops, _highest_vertex(caster.mesh, hulls))


def highest_vertex_under(caster: RayCaster, outlines: Sequence[FloatArray]) -> FloatArray:
    """Return the largest z (k,) of the wall's vertices within the contour of each of k blocks, m.

    Where a contour contains no vertex, it is the largest z of the surface.

    Parameters
    ----------
    caster : RayCaster
        The wall, wall frame.
    outlines : sequence of (n, 2) arrays
        For each block, points (x, y), wall frame, m, whose convex hull is its contour.
    """
    tops = _highest_vertex(caster.mesh, [_Hull(points) for points in outlines])
    bare = np.flatnonzero(np.isneginf(tops))
    if bare.size:
        tops[bare] = highest_under(caster, [outlines[index] for index in bare.tolist()])
    return tops


def median_under(caster: RayCaster, outlines: Sequence[FloatArray]) -> FloatArray:
    """Return the median z (k,) of the wall within the contour of each of k blocks, m; -inf where there is no wall.

    A block whose middle lies at this height is about half in the rock.

    Parameters
    ----------
    caster : RayCaster
        The wall, wall frame.
    outlines : sequence of (n, 2) arrays
        For each block, points (x, y), wall frame, m, whose convex hull is its contour.
    """
    found = _heights(caster, [_Hull(points) for points in outlines], edges=False)
    return np.array([np.median(values) if values.size else -np.inf for values in found])


class _Hull:
    """The convex hull of points (n, 2): its corners (m, 2), and lines (m, 3) with a x + b y + c <= 0 inside."""

    def __init__(self, points: FloatArray) -> None:
        from scipy.spatial import ConvexHull

        hull = ConvexHull(points)
        self.corners: FloatArray = points[hull.vertices]
        self._lines: FloatArray = hull.equations

    @property
    def box(self) -> FloatArray:
        """(2, 2) smallest and largest x and y."""
        return np.stack([self.corners.min(axis=0), self.corners.max(axis=0)])

    def holds(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return whether points (n, 2) lie inside."""
        return np.asarray((points @ self._lines[:, :2].T + self._lines[:, 2] <= 0).all(axis=1))

    def edge(self) -> FloatArray:
        """Return the corners and evenly spaced points on the outline, (n, 2)."""
        ends = np.concatenate([self.corners, self.corners[:1]])
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ends, axis=0), axis=1))])
        places = np.concatenate([along[:-1], np.linspace(0, along[-1], 4 * _SIDE, endpoint=False)])
        return np.column_stack([np.interp(places, along, ends[:, axis]) for axis in (0, 1)])

    def grid(self) -> FloatArray:
        """Return evenly spaced points inside, (n, 2)."""
        low, high = self.box
        steps = (np.arange(_SIDE) + 0.5) / _SIDE
        places = low + (high - low) * np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        return places[self.holds(places)]


def _heights(caster: RayCaster, hulls: Sequence[_Hull], *, edges: bool = True) -> list[FloatArray]:
    """Return, for each hull, the wall's heights along -z at evenly spaced points inside and, on request, on its outline."""
    places = [np.concatenate([hull.grid(), hull.edge()]) if edges else hull.grid() for hull in hulls]
    flat = np.concatenate(places)
    start = np.column_stack([flat, np.full(len(flat), caster.mesh.bounds[1, 2] + 1.0)])
    distance, _ = caster.cast(start, np.tile([0.0, 0.0, -1.0], (len(flat), 1)))
    parts = np.split(start[:, 2] - distance, np.cumsum([len(each) for each in places])[:-1])
    return [part[np.isfinite(part)] for part in parts]


def _highest_vertex(mesh: TriangleMesh, hulls: Sequence[_Hull]) -> FloatArray:
    """Return the largest z (k,) of the vertices within each hull; -inf if there are none."""
    boxes = np.stack([hull.box for hull in hulls])
    near = np.unique(mesh.faces[faces_under_boxes(mesh, boxes)])
    vertices = mesh.vertices[near]
    vertices = vertices[np.argsort(vertices[:, 0], kind="stable")]
    first = np.searchsorted(vertices[:, 0], boxes[:, 0, 0], side="left")
    last = np.searchsorted(vertices[:, 0], boxes[:, 1, 0], side="right")
    tops = np.full(len(hulls), -np.inf)
    for number, (hull, (low, high)) in enumerate(zip(hulls, boxes[:, :, 1], strict=True)):
        strip = vertices[first[number] : last[number]]
        strip = strip[(strip[:, 1] >= low) & (strip[:, 1] <= high)]
        tops[number] = strip[hull.holds(strip[:, :2]), 2].max(initial=-np.inf)
    return tops
