"""Repair a triangle mesh so that it is manifold and consistently wound.

The steps are: weld vertices, remove degenerate and duplicate triangles, unify the winding, separate parts that only touch.
Every step returns the repaired mesh and a description of what it did ("" for nothing). All steps are vectorised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.common.errors import InputError
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray, TriangleMesh

Repaired = tuple[TriangleMesh, str]
"""A mesh after one repair, and the repair in words ("" if there was nothing to do)."""
Index = NDArray[np.int64]

WELD_M = 1e-6
"""Vertices closer than this are welded, m."""
_FLAT_M = 1e-9
"""A triangle with a smaller height than this counts as having no area, m."""
_SMALLEST_AREA_M2 = 1e-6
"""Removed area below which the report does not say where it was, m2."""
_FACES_AT_ONCE = 1 << 14
"""Number of triangles processed at a time; their corners then stay in the processor's cache."""
_DIRECTION = np.array([0.5377, 0.6349, 0.5548])
"""An oblique direction along which vertices are sorted to find close ones."""


def clean(mesh: TriangleMesh, where: str, origin: FloatArray | None = None) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Repair a mesh that a user imports (duplicate vertices and triangles, wrong winding) and report what was repaired.

    Parameters
    ----------
    mesh : TriangleMesh
        The mesh, in local coordinates near the origin, m, so that float64 resolves far less than a micrometre.
    where : str
        Name of the mesh in error messages, such as its file.
    origin : (3,) array, optional
        Origin of the local coordinates in the user's coordinate system, m. Only the report uses it.

    Returns
    -------
    TriangleMesh, tuple of str
        The repaired mesh, and each repair in words with its count.

    Raises
    ------
    InputError
        If no triangle with an area is left, or the surface has only one side.
    """
    steps: tuple[Callable[[TriangleMesh], Repaired], ...] = (weld, drop_degenerate, partial(drop_duplicates, origin=origin))
    repairs = []
    for step in steps:
        mesh, words = step(mesh)
        repairs.append(words)
        if not len(mesh.faces):
            raise InputError(
                "no triangle has an area: all vertices lie on lines or points",
                where=where,
                remedy="export the mesh again from the program that made it, with triangles that have an area",
            )
    mesh, words = unify_winding(mesh, where)
    repairs.append(words)
    for step in (separate_touching_parts, drop_unused):
        mesh, words = step(mesh)
        repairs.append(words)
    return mesh, tuple(text for text in (*repairs, describe_pieces(mesh)) if text)


def weld(mesh: TriangleMesh) -> Repaired:
    """Merge vertices that lie within 1 micrometre of each other, directly or through a chain of such vertices.

    The first one is kept. Returns the repaired mesh, and the repair in words with its count ("" if none).
    """
    first, inverse = unique_rows(mesh.vertices + 0.0)  # + 0.0: minus zero is zero
    near = _near_pairs(mesh.vertices[first])
    if len(near):
        group = connected_groups(near, len(first))
        first, inverse = first[np.unique(group, return_index=True)[1]], group[inverse]
    removed = len(mesh.vertices) - len(first)
    if not removed:
        return mesh, ""
    albedo = None if mesh.vertex_albedo is None else mesh.vertex_albedo[first]
    welded = replace(mesh, vertices=mesh.vertices[first], faces=inverse[mesh.faces].astype(np.int32), vertex_albedo=albedo)
    return welded, f"{removed} duplicate vertices welded"


def drop_degenerate(mesh: TriangleMesh) -> Repaired:
    """Remove triangles without an area: two equal corners, or three corners on one line.

    Returns the repaired mesh, and the repair in words with its count ("" if none).
    """
    keep = _in_chunks(mesh, _has_area, bool)
    return _drop_faces(mesh, keep, "degenerate triangles removed")


def drop_duplicates(mesh: TriangleMesh, origin: FloatArray | None = None) -> Repaired:
    """Remove all but the first of the triangles with the same three vertices, whatever their winding.

    origin: (3,) origin of the mesh's coordinates in the user's coordinate system, m, for the report alone. Returns the repaired
    mesh, and the repair in words with its count ("" if none).
    """
    first, _ = unique_rows(np.sort(mesh.faces, axis=1))
    keep = np.zeros(len(mesh.faces), bool)
    keep[first] = True
    return _drop_faces(mesh, keep, "duplicate triangles removed", origin)


def unify_winding(mesh: TriangleMesh, where: str) -> Repaired:
    """Flip the triangles that are wound opposite to the majority of their connected piece.

    where: name of the mesh in error messages. Returns the repaired mesh, and the repair in words with its count ("" if none).
    Raises InputError for a surface with only one side.
    """
    odd = inconsistent_faces(mesh, where)
    return (flip_faces(mesh, odd), f"{int(odd.sum())} triangles wound the other way round") if odd.any() else (mesh, "")


def inconsistent_faces(mesh: TriangleMesh, where: str) -> NDArray[np.bool_]:
    """Find the triangles that are wound opposite to the majority of their connected piece: a bool array (m,).

    Vertices must be welded (no two at the same place). Each triangle is represented twice in a graph, as it is and flipped;
    neighbours are joined so that their windings agree. A piece whose two copies are connected has only one side, which raises
    InputError. Triangles are not neighbours across an edge that more than two of them share. `where` is the name of the mesh in
    error messages.
    """
    count = len(mesh.faces)
    pair, same = _neighbours(mesh)
    if not same.any():
        return np.zeros(count, bool)
    flip, none = same * count, np.zeros(len(same), np.int64)
    links = np.concatenate([pair + np.stack([none, flip], axis=1), pair + np.stack([none + count, count - flip], axis=1)])
    label = connected_groups(links, 2 * count)
    if np.any(label[:count] == label[count:]):
        raise InputError(
            "the surface has only one side (a Moebius strip), so it has no outside",
            where=where,
            remedy="cut the surface open in a mesh editor such as MeshLab, so that it has two sides",
        )
    size = np.bincount(label[:count], minlength=label.max() + 1)
    minor = size[label[:count]] < size[label[count:]]
    tie = (size[label[:count]] == size[label[count:]]) & (label[:count] > label[count:])
    return minor | tie


def separate_touching_parts(mesh: TriangleMesh) -> Repaired:
    """Give parts of the surface that touch in a vertex or along an edge vertices of their own.

    No triangle is removed. Parts that touch, such as a rock on the ground, keep their positions but are no longer connected.
    Triangles are connected across an edge that exactly two of them share. The mesh must be consistently wound. Returns the
    repaired mesh, and the repair in words with its count ("" if none).
    """
    pinched = _pinched(mesh)
    if not pinched.any():
        return mesh, ""
    near = np.flatnonzero(pinched[mesh.faces].any(axis=1))
    patch = replace(mesh, faces=mesh.faces[near])
    corners, count = patch.faces.T.ravel(), len(near)
    one, other = patch.shared_edges  # consistent winding: the two run in opposite directions
    links = np.concatenate([np.stack([one, (other + count) % (3 * count)], 1), np.stack([(one + count) % (3 * count), other], 1)])
    fan = connected_groups(links, 3 * count)
    first, size = np.unique(fan, return_index=True, return_counts=True)[1:]
    centre = corners[first]
    ranked = np.lexsort((-size, centre))
    again = np.zeros(len(ranked), bool)
    again[ranked[1:]] = centre[ranked[1:]] == centre[ranked[:-1]]
    new = again & pinched[centre]  # the largest fan keeps the vertex
    number = centre.astype(np.int64)
    number[new] = len(mesh.vertices) + np.arange(int(new.sum()))
    faces = mesh.faces.copy()
    faces[near] = number[fan].reshape(3, count).T
    chosen = np.concatenate([np.arange(len(mesh.vertices)), centre[new]])
    albedo = None if mesh.vertex_albedo is None else mesh.vertex_albedo[chosen]
    parted = replace(mesh, vertices=mesh.vertices[chosen], faces=faces, vertex_albedo=albedo)
    return parted, f"parts of the surface that touch kept apart at {int(pinched.sum())} vertices"


def drop_unused(mesh: TriangleMesh) -> Repaired:
    """Remove the vertices that no triangle uses.

    Returns the repaired mesh, and the repair in words with its count ("" if none).
    """
    kept = mesh.submesh()
    unused = len(mesh.vertices) - len(kept.vertices)
    return (kept, f"{unused} unused vertices removed") if unused else (mesh, "")


def describe_pieces(mesh: TriangleMesh) -> str:
    """Describe in words, for a report, the pieces of a mesh that are not connected to its largest one; "" if there are none."""
    label = connected_groups(mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(mesh.vertices))
    sizes = np.sort(np.bincount(label[mesh.faces[:, 0]]))
    if len(sizes) == 1:
        return ""
    return f"kept {len(sizes) - 1} pieces apart from the main surface, of {sizes[0]} to {sizes[-2]} triangles"


def flip_faces(mesh: TriangleMesh, which: NDArray[np.bool_]) -> TriangleMesh:
    """Return the mesh with the winding of some triangles reversed, so that they face the other side.

    which: (m,) mask of the triangles to flip.
    """
    return replace(mesh, faces=np.where(which[:, None], mesh.faces[:, ::-1], mesh.faces))


def triangle_areas(mesh: TriangleMesh) -> FloatArray:
    """Return the area of each of a mesh's m triangles, (m,), m2."""
    return _in_chunks(mesh, _areas, float)


def _in_chunks(mesh: TriangleMesh, evaluate: Callable[[FloatArray], NDArray[Any]], kind: type) -> NDArray[Any]:
    """Apply `evaluate` to the corners (k, 3, 3) of some triangles at a time, and return the results (m,) of type `kind`."""
    result: NDArray[Any] = np.empty(len(mesh.faces), kind)

    def fill(start: int) -> None:
        part = slice(start, start + _FACES_AT_ONCE)
        result[part] = evaluate(mesh.vertices[mesh.faces[part]])

    map_in_threads(fill, range(0, len(result), _FACES_AT_ONCE))
    return result


def _areas(corners: FloatArray) -> FloatArray:
    """Return the areas (k,) of triangles by their corners, m2."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.sqrt(_squared(np.cross(first, second))) / 2


def _has_area(corners: FloatArray) -> NDArray[np.bool_]:
    """Return whether each triangle's smallest height exceeds _FLAT_M."""
    sides = (_squared(corners[:, start] - corners[:, end]) for start, end in ((0, 1), (1, 2), (2, 0)))
    return 2 * _areas(corners) > _FLAT_M * np.sqrt(reduce(np.maximum, sides))


def _squared(vectors: FloatArray) -> FloatArray:
    """Return the squared lengths (k,) of vectors (k, 3)."""
    return np.einsum("ki,ki->k", vectors, vectors)


def unique_rows(rows: NDArray[np.generic]) -> tuple[Index, Index]:
    """Find groups of equal rows in an array (n, 3), such as vertices at the same place.

    Returns the index of the first row of each group, in order of appearance, and the group of every row (n,). Rows are sorted
    by a 64-bit hash; should two different rows share a hash, they are sorted in full.
    """
    key = np.zeros(len(rows), np.uint64)
    for column in rows.T.astype(f"{rows.dtype.kind}8"):
        key = (key ^ (key >> np.uint64(29)) ^ column.view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
    ordered = np.sort(key)
    if np.all(ordered[1:] != ordered[:-1]):
        return np.arange(len(rows)), np.arange(len(rows))
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    if not np.array_equal(rows[first][inverse], rows):
        _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return first[order], place[inverse.ravel()]


def _near_pairs(vertices: FloatArray) -> Index:
    """Return the pairs (k, 2) of vertices within WELD_M of each other. Candidates are neighbours along one oblique direction."""
    along = np.einsum("ni,i->n", vertices, _DIRECTION)
    order = np.argsort(along, kind="stable")
    along = along[order]
    candidate = np.arange(len(order) - 1)
    found = [np.empty((0, 2), np.int64)]
    for lag in range(1, len(order)):
        candidate = candidate[: np.searchsorted(candidate, len(order) - lag)]
        candidate = candidate[along[candidate + lag] - along[candidate] <= WELD_M]
        if not len(candidate):
            break
        pair = order[np.stack([candidate, candidate + lag], axis=1)]
        distance = vertices[pair[:, 0]] - vertices[pair[:, 1]]
        found.append(pair[np.sum(distance**2, axis=1) <= WELD_M**2])
    return np.concatenate(found)


def connected_groups(pairs: NDArray[np.integer], count: int) -> Index:
    """Find which elements, such as triangles, are connected, directly or through others.

    pairs: (k, 2) numbers of linked elements. count: number of elements. Returns the number of each element's group (count,);
    groups are numbered by first appearance.

    Every element points to the smallest element of its group known so far. A round links the groups that a pair joins to the
    smaller one, then follows the pointers to their ends (Shiloach and Vishkin 1982). SciPy's version takes as long, and its
    import takes longer.
    """
    smallest = np.arange(count, dtype=pairs.dtype)  # with one type throughout, NumPy's loops are three times as fast
    start, end = pairs.T
    while len(start):
        low, high = np.minimum(start, end), np.maximum(start, end)
        np.minimum.at(smallest, high, low)
        while not np.array_equal(further := smallest[smallest], smallest):
            smallest = further
        start, end = smallest[low], smallest[high]
        apart = start != end
        start, end = start[apart], end[apart]
    return (np.cumsum(smallest == np.arange(count)) - 1)[smallest]


def _neighbours(mesh: TriangleMesh) -> tuple[Index, NDArray[np.bool_]]:
    """Return pairs (k, 2) of triangles that share an edge, and whether their winding is inconsistent.

    The winding is inconsistent if both triangles run along the edge in the same direction.
    """
    start = mesh.faces.T.ravel()
    one, other = mesh.shared_edges
    return np.stack([one, other], axis=1) % len(mesh.faces), start[one] == start[other]


def _pinched(mesh: TriangleMesh) -> NDArray[np.bool_]:
    """Find the vertices (n,) whose triangles do not form one fan.

    Walking around such a vertex, edge by edge, misses some of its triangles.
    """
    count, corners = len(mesh.faces), mesh.faces.T.ravel()  # half-edge k m + f leaves corner k of triangle f
    one, other = mesh.shared_edges
    twin = np.full(3 * count, -1)
    twin[one], twin[other] = other, one
    rim = np.flatnonzero(twin < 0)
    start = np.full(len(mesh.vertices), -1)
    start[corners] = np.arange(3 * count)
    start[corners[rim]] = rim  # the walk around an open fan starts at its rim
    unmet = np.bincount(corners, minlength=len(mesh.vertices))
    vertex = np.flatnonzero(start >= 0)
    edge = start[vertex]
    while len(vertex):
        unmet[vertex] -= 1
        edge = twin[(edge + 2 * count) % (3 * count)]  # the twin of the edge that ends here leaves here too
        onwards = (edge >= 0) & (edge != start[vertex])
        vertex, edge = vertex[onwards], edge[onwards]
    return unmet > 0


def _drop_faces(mesh: TriangleMesh, keep: NDArray[np.bool_], words: str, origin: FloatArray | None = None) -> Repaired:
    """Keep some of the faces, and describe the removed ones."""
    if keep.all():
        return mesh, ""
    return replace(mesh, faces=mesh.faces[keep]), f"{int(np.sum(~keep))} {words}{_describe_removed(mesh, ~keep, origin)}"


def _describe_removed(mesh: TriangleMesh, removed: NDArray[np.bool_], origin: FloatArray | None) -> str:
    """Describe how large the removed triangles are and where the first of them lies; "" if they have no area."""
    lost = replace(mesh, faces=mesh.faces[removed])
    if (area := float(triangle_areas(lost).sum())) < _SMALLEST_AREA_M2:
        return ""
    x, y, z = lost.corners()[0].mean(axis=0) + (0.0 if origin is None else origin)
    return f" ({area:.3g} m2, the first at {x:.2f}, {y:.2f}, {z:.2f})"
