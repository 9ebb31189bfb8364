"""Remove the slivers (needle-shaped triangles) that a boolean leaves along its cuts, by edge collapses and edge flips.

No vertex moves. Each round picks operations whose neighbourhoods do not touch, so that all of them can be applied at once. An
edge is collapsed only if the surface stays manifold (link condition: the ends of the edge share no neighbours except the
apexes of its two faces) and no sound face turns over. It is flipped only if this increases the smaller of the two heights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.blocks.solid import boundary, prism_volumes
from scene.geometry.mesh import FloatArray, IntArray, compact_vertices

SLIVER_M = 2e-5
"""A face whose smallest height is below this is a sliver: single precision (8 um at 70 m) would lose its normal."""

_COLLAPSIBLE_M = 3 * SLIVER_M
"""Length up to which an edge of a sliver is collapsed in the first attempt. Slivers without such an edge are flipped away."""

_ATTEMPTS, _ROUNDS = 10, 40

_RINGS = 3
"""Rings of faces around slivers that are processed: a collapse needs two; a third leaves room for the next collapse."""

BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]


def smallest_height(corners: FloatArray) -> FloatArray:
    """Return the height, m, of each of n triangles over its longest side, (n,), to find needle-shaped triangles (slivers).

    corners: (n, 3, 3) array with the three corners of each triangle, m.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    longest = np.sqrt(np.maximum(np.maximum(_square(b - a), _square(c - b)), _square(a - c)))
    return np.sqrt(_square(_normal(corners))) / np.maximum(longest, 1e-300)


def _square(vectors: FloatArray) -> FloatArray:
    """Return the squared lengths (n,) of vectors (n, 3)."""
    return np.einsum("ni,ni->n", vectors, vectors)


def _normal(corners: FloatArray) -> FloatArray:
    """Return the normals (m, 3) of triangles (m, 3, 3), twice as long as their area."""
    (ux, uy, uz), (vx, vy, vz) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=1)


@dataclass(frozen=True)
class _RankedEdges:
    """Edges (start, end) to process, in order of preference, and the faces that touch them.

    operation, face: (p,) pairs of an edge's number and a face that contains its start or end.
    """

    start: IndexArray
    end: IndexArray
    operation: IndexArray
    face: IndexArray

    def only(self, chosen: BoolArray) -> _RankedEdges:
        """Return the chosen edges, in the same order."""
        number = np.cumsum(chosen) - 1
        kept = chosen[self.operation]
        return _RankedEdges(self.start[chosen], self.end[chosen], number[self.operation[kept]], self.face[kept])


@dataclass(frozen=True)
class MendedSurface:
    """The surface of a wall with niches after the slivers (needle-shaped triangles) along the cuts were removed.

    Attributes
    ----------
    faces : (m, 3) int32 array
        Vertex indices of the m remaining triangles.
    label : (m,) int32 array
        Label of the block whose niche each face belongs to; 0 on the wall.
    gain_m3 : (largest label + 1,) array
        Volume below the surface (towards -z) that the removal of slivers has added, m3: entry i for slivers near faces of label
        i.
    """

    faces: IntArray
    label: IntArray
    gain_m3: FloatArray


def remove_slivers(vertices: FloatArray, faces: IntArray, label: IntArray, rank: NDArray[np.int8]) -> MendedSurface:
    """Remove the slivers (needle-shaped triangles) that cutting blocks out of a wall leaves along the cut.

    Edges are collapsed or flipped; faces away from slivers stay.

    Parameters
    ----------
    vertices : (n, 3) array
        Positions, m. None is moved, but some are no longer used afterwards.
    faces : (m, 3) int32 array
        Vertex indices.
    label : (m,) int32 array
        Label of the block whose niche each face belongs to; 0 on the wall.
    rank : (n,) int8 array
        0 for vertices that must stay, 1 for those of the original wall, 2 for those on the cut. Of an edge's two vertices, the
        one with the higher rank is preferably removed.
    """
    cut, gain = rank == 2, np.zeros(int(label.max(initial=0)) + 1)
    suspects = np.flatnonzero(_touch(cut, faces))
    for attempt in range(_ATTEMPTS):
        bad = suspects[smallest_height(vertices[faces[suspects]]) < SLIVER_M]
        if not len(bad):
            break
        near = _grow_rings(faces, bad, len(vertices))
        limit_m = _COLLAPSIBLE_M * 2.0**attempt  # allow longer collapses for the slivers that remain
        mended, labels = _mend_patch(vertices, faces[near], label[near], rank, cut, limit_m)
        gain += _added_volume(vertices, faces[near], label[near], mended, len(gain))
        away = np.ones(len(faces), dtype=bool)
        away[near] = False
        faces, label = np.concatenate([faces[away], mended]), np.concatenate([label[away], labels])
        suspects = len(faces) - len(mended) + np.flatnonzero(_touch(cut, mended))
    return MendedSurface(faces, label, gain)


def _added_volume(vertices: FloatArray, before: IntArray, label: IntArray, after: IntArray, count: int) -> FloatArray:
    """Return the volume (count,) that each connected part of a surface has gained, under the largest label in that part."""
    from scipy import sparse

    used, number = compact_vertices(before)
    links = np.concatenate([number[:, :2], number[:, 1:]]).T
    graph = sparse.coo_array((np.ones(links.shape[1], dtype=bool), (links[0], links[1])), shape=(len(used), len(used)))
    parts, part = sparse.csgraph.connected_components(graph, directed=False)
    largest = np.zeros(parts, dtype=label.dtype)
    np.maximum.at(largest, part[number[:, 0]], label)
    now = np.bincount(part[np.searchsorted(used, after[:, 0])], prism_volumes(vertices, after), minlength=parts)
    then = np.bincount(part[number[:, 0]], prism_volumes(vertices, before), minlength=parts)
    return np.bincount(largest, now - then, minlength=count).astype(np.float64)


def _touch(flagged: BoolArray, faces: IntArray) -> BoolArray:
    """Return whether each face (m,) has a flagged vertex."""
    a, b, c = faces.T
    return flagged[a] | flagged[b] | flagged[c]


def _grow_rings(faces: IntArray, rows: IndexArray, count: int) -> IndexArray:
    """Return the faces within some rings around the given ones."""
    for _ in range(_RINGS):
        near = np.zeros(count, dtype=bool)
        near[faces[rows].ravel()] = True
        rows = np.flatnonzero(_touch(near, faces))
    return rows


def _mend_patch(
    vertices: FloatArray, faces: IntArray, label: IntArray, rank: NDArray[np.int8], cut: BoolArray, limit_m: float
) -> tuple[IntArray, IntArray]:
    """Remove slivers from a patch without changing its boundary. Vertices that edges collapse onto are added to `cut`."""
    used, faces = compact_vertices(faces)
    vertices, rank, part_cut = vertices[used], rank[used], cut[used]
    rank[boundary(faces)[0]] = 0
    for _ in range(_ROUNDS):
        vanished = _collapse(vertices, faces, rank, part_cut, _slivers(vertices, faces, part_cut), limit_m)
        faces, label = faces[~vanished], label[~vanished]
        flipped = _flip(vertices, faces, label, _slivers(vertices, faces, part_cut))
        if not (flipped or vanished.any()):
            break
    cut[used] = part_cut
    return used[faces].astype(np.int32), label


def _slivers(vertices: FloatArray, faces: IntArray, cut: BoolArray) -> IndexArray:
    """Return the slivers that have a vertex on the cut."""
    return np.flatnonzero(_touch(cut, faces) & (smallest_height(vertices[faces]) < SLIVER_M))


def _collapse(
    vertices: FloatArray, faces: IntArray, rank: NDArray[np.int8], cut: BoolArray, bad: IndexArray, limit: float
) -> BoolArray:
    """Collapse short edges of the bad faces in place, and return which faces (m,) have vanished."""
    start, end = _collapsible_edges(vertices, faces[bad], rank, limit)
    edges = _with_faces(faces, start, end, len(vertices))
    edges = edges.only(_keeps_manifold(faces, edges))
    edges = edges.only(_turns_no_face(vertices, faces, edges))
    edges = edges.only(_independent(faces, edges, len(vertices)))
    moved = np.arange(len(vertices), dtype=faces.dtype)
    moved[edges.start] = edges.end
    cut[edges.end] = True
    changed = np.unique(edges.face)
    faces[changed] = moved[faces[changed]]
    vanished = np.zeros(len(faces), dtype=bool)
    a, b, c = faces[changed].T
    vanished[changed] = (a == b) | (b == c) | (c == a)
    return vanished


def _collapsible_edges(
    vertices: FloatArray, faces: IntArray, rank: NDArray[np.int8], limit: float
) -> tuple[IndexArray, IndexArray]:
    """Return start (removed) and end (kept) of the sides of the faces up to the limit, both ways round, best first.

    Edges whose start has at least the rank of its end come first, shorter ones before longer ones.
    """
    first, second = faces.ravel().astype(np.intp), np.roll(faces, -1, axis=1).ravel().astype(np.intp)
    edges = np.unique(np.concatenate([first << 32 | second, second << 32 | first]))
    start, end = edges >> 32, edges & 0xFFFFFFFF
    length = np.sqrt(_square(vertices[end] - vertices[start]))
    order = np.lexsort((length, rank[start] < rank[end]))
    order = order[(length[order] <= limit) & (rank[start[order]] > 0)]
    return start[order], end[order]


def _with_faces(faces: IntArray, start: IndexArray, end: IndexArray, count: int) -> _RankedEdges:
    """Find the faces that touch each edge."""
    near = np.zeros(count, dtype=bool)
    near[start] = near[end] = True
    rows = np.flatnonzero(_touch(near, faces))
    corner = faces[rows].ravel()
    order = np.argsort(corner, kind="stable")
    wanted = np.concatenate([start, end])
    first, last = (np.searchsorted(corner[order], wanted, side=side) for side in ("left", "right"))
    operation = np.tile(np.arange(len(start)), 2)
    pair = np.repeat(operation, last - first)
    within = np.arange(len(pair)) - np.repeat(np.cumsum(last - first) - (last - first), last - first)
    face = rows[order[np.repeat(first, last - first) + within] // 3]
    both = np.unique(np.stack([pair, face]), axis=1)
    return _RankedEdges(start, end, both[0], both[1])


def _keeps_manifold(faces: IntArray, edges: _RankedEdges) -> BoolArray:
    """Check the link condition: the two ends share as many neighbours as the edge has faces, which are two."""
    corners = faces[edges.face]
    at_start = (corners == edges.start[edges.operation, None]).any(axis=1)
    at_end = (corners == edges.end[edges.operation, None]).any(axis=1)
    around = [np.unique(edges.operation[at, None] << 32 | corners[at]) for at in (at_start, at_end)]
    shared = np.intersect1d(around[0], around[1], assume_unique=True) >> 32
    count = len(edges.start)
    common = np.bincount(shared, minlength=count) - 2  # the two ends themselves
    return (np.bincount(edges.operation[at_start & at_end], minlength=count) == 2) & (common == 2)


def _turns_no_face(vertices: FloatArray, faces: IntArray, edges: _RankedEdges) -> BoolArray:
    """Return whether collapsing each edge turns no sound face that remains by more than a right angle."""
    corners = faces[edges.face]
    start, end = edges.start[edges.operation, None], edges.end[edges.operation, None]
    stays = (corners == start).any(axis=1) & ~(corners == end).any(axis=1)
    before = vertices[corners]
    after = vertices[np.where(corners == start, end, corners)]
    turns = stays & (smallest_height(before) >= SLIVER_M) & (np.einsum("mi,mi->m", _normal(before), _normal(after)) <= 0)
    return np.bincount(edges.operation[turns], minlength=len(edges.start)) == 0


def _independent(faces: IntArray, edges: _RankedEdges, count: int) -> BoolArray:
    """Return the edges that come first at every vertex of their faces, so that no two of them share a neighbourhood."""
    best = np.full(count, len(edges.start))
    around, operation = faces[edges.face].ravel(), np.repeat(edges.operation, 3)
    np.minimum.at(best, around, operation)
    return np.bincount(operation[best[around] != operation], minlength=len(edges.start)) == 0


def _flip(vertices: FloatArray, faces: IntArray, label: IntArray, bad: IndexArray) -> bool:
    """Flip the longest edge of the bad faces in place where this helps, and return whether any edge was flipped.

    Both new faces take the label of the other face. For a sliver whose apex lies almost on its longest edge, this removes the
    sliver and inserts its apex into the edge of the face beyond.
    """
    ends = np.roll(faces[bad], -1, axis=1)
    side = np.linalg.norm(vertices[ends] - vertices[faces[bad]], axis=2).argmax(axis=1)
    rows = np.arange(len(bad))
    start, end = faces[bad][rows, side].astype(np.intp), ends[rows, side].astype(np.intp)
    apex = faces[bad][rows, (side + 2) % 3]
    edges = _with_faces(faces, start, end, len(vertices))
    corners = faces[edges.face]
    found = np.zeros((len(bad), 2), dtype=np.intp)  # the other face, and its vertex beyond the edge
    beyond = (corners == end[edges.operation, None]) & (np.roll(corners, -1, axis=1) == start[edges.operation, None])
    pair, corner = np.nonzero(beyond)
    found[edges.operation[pair]] = np.stack([edges.face[pair], corners[pair, (corner + 2) % 3]], axis=1)
    count = np.bincount(edges.operation[pair], minlength=len(bad))
    other, far = found.T
    first = np.stack([start, far, apex], axis=1)
    second = np.stack([far, end, apex], axis=1)
    before = np.minimum(smallest_height(vertices[faces[bad]]), smallest_height(vertices[faces[other]]))
    after = np.minimum(smallest_height(vertices[first]), smallest_height(vertices[second]))
    chosen = (count == 1) & (after > 1.5 * before) & ~_joined(faces, apex, far, len(vertices))
    chosen &= _agree(vertices, faces[other], first) & _agree(vertices, faces[other], second)
    edges = edges.only(chosen)
    free = _independent(faces, edges, len(vertices))
    chosen = np.flatnonzero(chosen)[free]
    faces[bad[chosen]], faces[other[chosen]] = first[chosen], second[chosen]
    label[bad[chosen]] = label[other[chosen]]
    return len(chosen) > 0


def _joined(faces: IntArray, first: IndexArray, second: IndexArray, count: int) -> BoolArray:
    """Return whether each pair of vertices is already connected by an edge."""
    edges = _with_faces(faces, first, second, count)
    corners = faces[edges.face]
    both = (corners == first[edges.operation, None]).any(axis=1) & (corners == second[edges.operation, None]).any(axis=1)
    return np.bincount(edges.operation[both], minlength=len(first)) > 0


def _agree(vertices: FloatArray, old: IntArray, new: IntArray) -> BoolArray:
    """Return whether each new face's normal is within a right angle of the old one's; True where the old face is a sliver."""
    corners = vertices[old]
    return (np.einsum("mi,mi->m", _normal(corners), _normal(vertices[new])) > 0) | (smallest_height(corners) < SLIVER_M)
