"""Search the nearest points of a cloud with a search tree that two threads build."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_LEAF_POINTS = 16
"""Largest number of points in a leaf of the tree."""


class SearchTree:
    """Search tree of a cloud, in two halves, each of which a thread builds.

    Points that follow one another in memory should be neighbours in space, so that most searches need only one half.
    """

    def __init__(self, points: FloatArray) -> None:
        from scipy.spatial import cKDTree

        halves = np.array_split(points, 2)
        self.size, self.starts = len(points), (0, len(halves[0]))
        self.trees: list[Any] = map_in_threads(lambda half: cKDTree(half, _LEAF_POINTS, balanced_tree=False), halves)

    def query(self, points: FloatArray, neighbours: int, limit: float = np.inf) -> tuple[FloatArray, NDArray[np.intp]]:
        """Search the nearest points of the cloud within a distance limit.

        Parameters
        ----------
        points : (n, 3) array
            Where to search, m; neighbours in space, for speed.
        neighbours : int
            Number k of nearest points to find for each.
        limit : float
            Distance, m, that the points found do not reach.

        Returns
        -------
        (n, k) distances, m, and (n, k) indices in the cloud, the nearest first. Where there is no further point within the
        limit, the distance is infinite and the index is the number of points in the cloud.
        """
        box = np.array([[column.min(initial=np.inf), column.max(initial=-np.inf)] for column in points.T])
        gaps = [_distance(box[:, 0], box[:, 1], tree) for tree in self.trees]
        first = int(gaps[1] < gaps[0])
        distance, found = self._query_half(first, points, neighbours, limit)
        if not len(points) or gaps[1 - first] > np.minimum(distance[:, -1].max(), limit):
            return distance, found
        rest = np.flatnonzero(_distance(points, points, self.trees[1 - first]) <= np.minimum(distance[:, -1], limit))
        further = self._query_half(1 - first, points[rest], neighbours, limit)
        distances = np.concatenate([distance[rest], further[0]], axis=1)
        indices = np.concatenate([found[rest], further[1]], axis=1)
        nearest = np.argsort(distances, axis=1, kind="stable")[:, :neighbours]
        distance[rest] = np.take_along_axis(distances, nearest, axis=1)
        found[rest] = np.take_along_axis(indices, nearest, axis=1)
        return distance, found

    def _query_half(self, half: int, points: FloatArray, neighbours: int, limit: float) -> tuple[FloatArray, NDArray[np.intp]]:
        """Search one half of the cloud; see `query`."""
        ranks = range(1, neighbours + 1)
        distance, found = self.trees[half].query(points, k=ranks, distance_upper_bound=limit)
        return distance, np.where(np.isfinite(distance), found + self.starts[half], self.size)


def _distance(low: FloatArray, high: FloatArray, tree: Any) -> Any:
    """Return the distance, m, of boxes with the corners `low` and `high` (..., 3) from the box of a tree's points."""
    return np.linalg.norm(np.maximum(np.maximum(tree.mins - high, low - tree.maxes), 0), axis=-1)
