"""Pair points with their nearest reference points in the iterations of ICP, and sum up the pairs fast and reproducibly.

Most points keep their nearest reference point from one iteration to the next. A search finds the distances d1 and d2 of the
nearest and the second nearest one. After the point has moved by s, the nearest one is at most d1 + s away, and all others are at
least d2 - s away. So it remains the nearest one as long as d2 - d1 > 2 s. Only the other points are searched again, and the pairs
are the same as those of a search for every point.

Sums are taken over blocks of fixed size in a fixed order, so that the result is the same to the bit for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.rigid import RigidTransform
from scene.geometry.mesh import FloatArray

_BLOCK = 2**12
"""Number of points per block of the sums; its arrays fit a core's cache."""
_ROUNDING_M = 1e-9
"""Lead, m, below which a point is searched again, so that rounding of the distances does not matter."""

Part = NDArray[np.intp] | slice
"""Which points of a cloud make up a block: their indices, or a slice."""
Map = Callable[[Callable[[Part], FloatArray], Iterable[Part]], Iterable[FloatArray]]
"""`map`, or the `map` method of an executor."""


class NearestPairs:
    """Hold the pairs of moving points and nearest reference points from one iteration of ICP to the next.

    Attributes
    ----------
    surface : ReferenceSurface
        The reference.
    points : (n, 3) array
        The moving points, m.
    pose : RigidTransform
        Pose of the moving points in the last iteration.
    nearest : (n,) array of int
        Index of the nearest reference point of each moving point; the number of reference points if there is no pair.
    lead_m : (n,) array
        d2 - d1 - 2 s of each moving point, m, where s is the length of its path since its search. If it is positive, the point
        keeps its pair.
    """

    def __init__(self, surface: ReferenceSurface, points: FloatArray) -> None:
        self.surface, self.points = surface, points
        self.pose = RigidTransform.identity()
        self.nearest = np.empty(len(points), dtype=np.intp)
        self.lead_m = np.full(len(points), -np.inf)

    def moments(
        self,
        parts: list[Part],
        pose: RigidTransform,
        gate: float,
        neighbours: int,
        normals: FloatArray | None,
        map_blocks: Map,
    ) -> FloatArray:
        """Pair moving points with their nearest reference points, and sum up what the normal equations of one iteration need.

        The result is the sum of u u^T over all pairs of a moved point p and a reference point q that are less than `gate`
        apart. The column vector u of a pair is, with the translation g of the pose and q's normal n:

        - with normals: ((p - g) x n, n, n . (p - q), 1), so that the result is (8, 8)
        - without normals: (p - g, q - p, 1), so that it is (7, 7)

        Its last element is the number of pairs. All coordinates are the reference's.

        Parameters
        ----------
        parts : list of Part
            The moving points of this iteration, divided into parts that are processed separately. They include all points of
            earlier iterations.
        pose : RigidTransform
            Moves the points to the reference's coordinates, whose zero is the centroid of the reference.
        gate : float
            Largest distance of a pair, m; at most that of earlier iterations.
        neighbours : int
            Number of neighbours that a search looks for. With 2, points can keep their pairs in later iterations; 1 is faster if
            none are likely to follow.
        normals : (m, 3) array, optional
            The reference's normals, for point-to-plane distances; None for point-to-point distances.
        map_blocks : Map
            Function like the built-in `map`, which may use threads.
        """

        def block_moments(part: Part) -> FloatArray:
            moved, nearest = self._pair(part, pose, gate, neighbours)
            offset = moved - self.surface.points.take(nearest, axis=0, mode="clip")
            arm, offset = (moved - pose.translation).T, offset.T
            near = offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2 < gate**2
            if normals is None:
                columns = _point_columns(arm, offset)
            else:
                columns = _plane_columns(arm, offset, normals.take(nearest, axis=0, mode="clip").T)
            columns *= near
            return np.einsum("in,jn->ij", columns, columns)

        total = np.sum(list(map_blocks(block_moments, parts)), axis=0)
        self.pose = pose
        return total

    def _pair(self, part: Part, pose: RigidTransform, gate: float, neighbours: int) -> tuple[FloatArray, NDArray[np.intp]]:
        """Return the moved points of a part, and the index of the nearest reference point of each within the gate."""
        points, lead, nearest = self.points[part], self.lead_m[part], self.nearest[part]
        moved = pose.apply(points)
        if np.isfinite(lead).any():
            step = moved - self.pose.apply(points)
            lead = lead - 2 * np.sqrt(np.einsum("ni,ni->n", step, step))
        again = np.flatnonzero(~(lead > _ROUNDING_M))
        distance, found = self.surface.tree.query(moved[again], neighbours, gate)
        nearest[again] = found[:, 0]
        lead[again] = np.minimum(distance[:, -1], gate) - distance[:, 0]
        self.lead_m[part], self.nearest[part] = lead, nearest
        return moved, nearest


def parts_of(indices: NDArray[np.intp] | int) -> list[Part]:
    """Divide points into consecutive parts of 4,096 points (the last may be shorter), to process them in threads.

    The size is fixed, so that sums do not depend on the number of threads. `indices` are those of the points (n,), or the number
    of points if all points of a cloud are used.
    """
    if isinstance(indices, int):
        return [slice(start, start + _BLOCK) for start in range(0, indices, _BLOCK)]
    return [indices[start : start + _BLOCK] for start in range(0, len(indices), _BLOCK)]


def _point_columns(arm: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the vectors u (7, k) of k pairs (`NearestPairs.moments`). arm: p - g; offset: p - q; (3, k) each, m."""
    return np.concatenate([arm, -offset, np.ones((1, arm.shape[1]))])


def _plane_columns(arm: FloatArray, offset: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the vectors u (8, k) of k pairs (`NearestPairs.moments`). arm: p - g; offset: p - q, m; normal: n; (3, k) each."""
    columns = np.ones((8, arm.shape[1]))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        columns[axis] = arm[i] * normal[j] - arm[j] * normal[i]
    columns[3:6] = normal
    columns[6] = normal[0] * offset[0] + normal[1] * offset[1] + normal[2] * offset[2]
    return columns
