"""Divide a wall that turns a corner or overhangs into views: parts that are each looked at along a direction of their own.

One projection stretches what stands steeply to it, and mixes surfaces that lie behind one another. The normals of small patches
of the reference are grouped by direction (k-means on the sphere); neighbouring patches decide together. A grid of cells in space
then says for each point to which view it belongs, whatever has fallen there since.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.registration.rigid import RigidTransform
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

MOST_VIEWS = 6
_PATCHES, _NEIGHBOURS = 3_000, 16
"""Patches whose normals are taken, and neighbouring ones through which a patch's plane is fitted: these are 0.5 % of the wall, so
that relief does not count."""
_STEEP_DEG, _MUCH = 65.0, 0.1
"""Angle of a patch to the direction of a single view, and share of the patches beyond it from which there are several views."""
_SEEN_WELL_DEG, _LEFT = 55.0, 0.05
"""Views are added until at most this share of the patches stands at more than this angle to its own."""
_ROUNDS, _SMOOTHINGS = 20, 4
_SMALLEST = 0.02
"""Share of the patches below which a view is given up."""
_CELLS = 128
"""Cells along the longest side of the wall."""


@dataclass(frozen=True)
class Partition:
    """Division of a wall into views (parts that are mapped along directions of their own), by a grid of cubes in space.

    The cubes also tell to which view a point of a later epoch belongs.

    Attributes
    ----------
    to_cells : RigidTransform
        From the frame of the points to the frame along whose axes the cubes lie.
    origin : (3,) array
        Corner of the first cube in that frame, m.
    cell_m : float
        Side of a cube, m.
    view : (i, j, k) int8 array
        Number of the view of each cube, from 0 on.
    directions : (n, 3) array
        Unit vector from the rock towards the air for each of the n views, frame of the cubes.
    """

    to_cells: RigidTransform
    origin: FloatArray
    cell_m: float
    view: NDArray[np.int8]
    directions: FloatArray

    def of(self, points: FloatArray) -> NDArray[np.int8]:
        """Return to which view (separately mapped part) of the wall each point belongs: numbers (k,) from 0 on.

        points: (k, 3), m, in the frame for which the partition was made. Points far from the wall count to the
        nearest view.
        """
        cell = np.floor((self.to_cells.apply(points) - self.origin) / self.cell_m).astype(np.int64)
        cell = np.clip(cell, 0, np.array(self.view.shape) - 1)
        return np.asarray(self.view[cell[:, 0], cell[:, 1], cell[:, 2]])

    def for_points(self, to_cells: RigidTransform) -> Partition:
        """Return the same division of the wall for points in another frame.

        to_cells: transform from that frame to the frame of the grid by which the wall is divided.
        """
        return replace(self, to_cells=to_cells)


def divided(points: FloatArray, towards: FloatArray, main: FloatArray, count: int | None) -> Partition | None:
    """Divide a wall that turns a corner or overhangs into views: parts that are mapped along directions of their own.

    Parameters
    ----------
    points : (n, 3) array
        Points of the reference, m; a subset suffices.
    towards : (3,) array
        A place in the air in front of the wall, which all parts of it face, same frame, m.
    main : (3,) array
        Unit vector along which the wall would be mapped with a single view, same frame.
    count : int or None
        Number of views given by the user; None: as many as the surface normals need, perhaps one.

    Returns
    -------
    Partition or None
        None if a single view is enough.
    """
    if count == 1:
        return None
    patches = _spread(points)
    normals, neighbours = _normals(patches, towards)
    if count is None and _share_beyond(normals @ main, _STEEP_DEG) <= _MUCH:
        return None
    for views in [count] if count else range(2, MOST_VIEWS + 1):
        directions = _directions(normals, main, views)
        if count or _share_beyond((normals @ directions.T).max(axis=1), _SEEN_WELL_DEG) <= _LEFT:
            break
    label = _smoothed(np.argmax(normals @ directions.T, axis=1), neighbours, len(directions))
    sizes = np.bincount(label, minlength=len(directions))
    kept = [view for view in np.argsort(-sizes, kind="stable") if sizes[view] > _SMALLEST * len(patches)]
    if len(kept) < 2:
        return None
    directions = np.array([_unit(normals[label == view].mean(axis=0)) for view in kept])
    label = _smoothed(np.argmax(normals @ directions.T, axis=1), neighbours, len(kept))
    return _in_cells(patches, label, directions)


def _spread(points: FloatArray) -> FloatArray:
    """Return a random subset of the points: every n-th of a raster or of scan lines may be a few columns of it."""
    if len(points) <= _PATCHES:
        return points
    random = KeyedRandom(0).child("monitor", "views").generator()
    return points[np.unique(random.integers(0, len(points), _PATCHES))]


def _normals(patches: FloatArray, towards: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """(n, 3) unit normals towards the outer side of planes through neighbouring patches, and (n, k) those neighbours."""
    from scipy.spatial import cKDTree

    _, neighbours = cKDTree(patches).query(patches, min(_NEIGHBOURS, len(patches)))
    local = patches[neighbours] - patches[neighbours].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    normals = vectors[:, :, 0]
    return _outward(normals, neighbours, towards - patches), neighbours


def _outward(normals: FloatArray, neighbours: NDArray[np.int64], to: FloatArray) -> FloatArray:
    """Turn the normals (n, 3) of patches to the outer side, of which the vectors `to` (n, 3) only tell most.

    Rough patches of a part that lies nearly along these vectors face away from them. So each patch first takes the side of the
    neighbour that is most nearly parallel (Hoppe et al. 1992, "Surface reconstruction from unorganized points", section 3.3),
    and a connected surface then the side that most of it has.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

    count, near = neighbours.shape
    one, other = np.repeat(np.arange(count), near - 1), neighbours[:, 1:].ravel()
    unlike = 1.0 - np.abs(np.einsum("ni,ni->n", normals[one], normals[other])) + 1e-6
    tree = minimum_spanning_tree(coo_array((unlike, (one, other)), shape=(count, count)).tocsr())
    parts, part = connected_components(tree, directed=False)
    found = normals.copy()
    for number in range(parts):
        first = int(np.flatnonzero(part == number)[0])
        order, before = breadth_first_order(tree, first, directed=False)
        for patch in order[1:]:
            if found[patch] @ found[before[patch]] < 0:
                found[patch] *= -1
        if np.einsum("ni,ni->n", found[order], to[order] / np.linalg.norm(to[order], axis=1, keepdims=True)).sum() < 0:
            found[order] *= -1
    return found


def _share_beyond(cosines: FloatArray, angle_deg: float) -> float:
    return float((cosines < np.cos(np.radians(angle_deg))).mean())


def _directions(normals: FloatArray, main: FloatArray, count: int) -> FloatArray:
    """(count, 3) unit vectors about which the normals gather, starting from those that are farthest apart."""
    starts = [_unit(normals[normals @ main > np.cos(np.radians(_SEEN_WELL_DEG))].sum(axis=0) + 1e-9 * main)]
    while len(starts) < count:
        worst = np.max(normals @ np.array(starts).T, axis=1)
        starts.append(normals[np.argsort(worst, kind="stable")[len(worst) // 100]])
    directions = np.array(starts)
    for _ in range(_ROUNDS):
        label = np.argmax(normals @ directions.T, axis=1)
        means = [normals[label == view].sum(axis=0) if (label == view).any() else directions[view] for view in range(count)]
        directions = np.array([_unit(mean) for mean in means])
    return directions


def _smoothed(label: NDArray[np.int64], neighbours: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Let each patch take the view of most of its neighbours, some times over."""
    for _ in range(_SMOOTHINGS):
        votes = np.stack([(label[neighbours] == view).sum(axis=1) for view in range(count)])
        label = np.argmax(votes, axis=0)
    return label


def _in_cells(patches: FloatArray, label: NDArray[np.int64], directions: FloatArray) -> Partition:
    """Give each cell of the wall's box the view of most patches in it, or of the nearest cell that has any."""
    from scipy import ndimage

    low, extent = patches.min(axis=0), np.ptp(patches, axis=0)
    cell = float(extent.max()) / _CELLS
    shape = tuple(int(size) for size in np.floor(extent / cell) + 1)
    place = np.ravel_multi_index(tuple(np.floor((patches - low) / cell).astype(np.int64).T), shape)
    votes = np.stack([np.bincount(place[label == view], minlength=int(np.prod(shape))) for view in range(len(directions))])
    view = np.argmax(votes, axis=0).reshape(shape)
    empty = (votes.sum(axis=0) == 0).reshape(shape)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return Partition(RigidTransform(np.eye(3), np.zeros(3)), low, cell, view[tuple(nearest)].astype(np.int8), directions)


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))
