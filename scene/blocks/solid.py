"""Make solids for Manifold from patches of a wall, and read the result of a boolean triangle by triangle.

A patch is closed by vertical sides below its boundary and a fan of triangles far below. A point under the patch is then inside
wherever the surface above it faces up once more than down. This count remains correct where a patch overlaps itself in XY
(overhangs, the back of a closed wall), which is all that Manifold's boolean needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Error, Manifold, Mesh64
from numpy.typing import NDArray

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh, compact_vertices

_MARGIN_M = 1.0
"""Distance from the lowest point of patch and blocks to the bottom of the closure."""

_SPREAD_M, _IRRATIONAL = 2e-6, (0.6180339887498949, 0.7548776662466927)
"""Offset of the foot of each side in x and y, m, and the irrational numbers that vary it. Where a straight boundary folds back on
itself, exactly vertical sides would overlap in one plane; Manifold would merge them into one flat face and retriangulate it,
neighbours included."""


@dataclass(frozen=True)
class Solid:
    """A closed mesh in the form of the library Manifold, which computes differences and intersections of solids (booleans).

    In the result of such a computation, each triangle keeps the row number of the triangle of this mesh that it is a part of.
    `manifold` is the mesh itself, and `identity` is the number by which the result tells which triangles come from it.
    """

    manifold: Manifold
    identity: int


@dataclass(frozen=True)
class Piece:
    """Mesh that results from a difference or intersection of two solids, with the origin of each face.

    Attributes
    ----------
    vertices : (n, 3) array
        Positions, m.
    faces : (m, 3) int32 array
        Vertex indices.
    source : (m,) int array
        Row of the original triangle that each face is a part of.
    first : (m,) bool array
        True where that triangle belongs to the first of the two solids (the wall), False for the second (the blocks).
    """

    vertices: FloatArray
    faces: IntArray
    source: NDArray[np.int64]
    first: NDArray[np.bool_]


def solid_of(vertices: FloatArray, faces: IntArray, name: str) -> Solid:
    """Make a solid, for differences and intersections, of a closed mesh.

    Parameters
    ----------
    vertices : (n, 3) array
        Positions, m.
    faces : (m, 3) int array
        Vertex indices.
    name : str
        What error messages call the mesh.

    Raises
    ------
    InputError
        If the triangles do not enclose a solid.
    """
    identity = Manifold.reserve_ids(1)
    manifold = Manifold(
        Mesh64(
            np.ascontiguousarray(vertices),
            faces.astype(np.uint64),
            run_index=np.array([0, 3 * len(faces)], dtype=np.uint64),
            run_original_id=np.array([identity], dtype=np.uint32),
            face_id=np.arange(len(faces), dtype=np.uint64),
        )
    )
    if manifold.status() != Error.NoError or manifold.num_tri() != len(faces):
        status = manifold.status().name if manifold.status() != Error.NoError else "degenerate triangles"
        raise InputError(
            f"the triangles make no solid ({status})",
            where=name,
            allowed="finite vertices; each edge in one triangle or in two of opposite direction; no triangles without area",
            remedy="in a mesh editor such as MeshLab, merge duplicate vertices and remove triangles without area",
        )
    return Solid(manifold, identity)


def split_wall(wall: Solid, blocks: Solid) -> tuple[Piece, Piece]:
    """Cut the blocks out of the wall.

    Returns two meshes: the rock that is removed, and the wall that is left, with its niches.
    """
    removed, left = wall.manifold.split(blocks.manifold)
    return read_piece(removed, wall), read_piece(left, wall)


def read_piece(result: Manifold, first: Solid) -> Piece:
    """Read the mesh that Manifold computed as the difference or intersection of two solids.

    result: Manifold's mesh. first: the first of the two solids, whose faces are told from those of the second one.
    """
    mesh = result.to_mesh64()
    run_end = np.asarray(mesh.run_index).astype(np.int64) // 3
    runs = run_end[1:] - run_end[:-1]
    is_first = np.repeat(np.asarray(mesh.run_original_id)[: len(runs)] == first.identity, runs)
    vertices, faces = np.asarray(mesh.vert_properties), np.asarray(mesh.tri_verts).astype(np.int32)
    return Piece(vertices, faces, np.asarray(mesh.face_id).astype(np.int64), is_first)


def close_patch(mesh: TriangleMesh, rows: IntArray, bottom_m: float) -> tuple[Solid, FloatArray]:
    """Close a part of an open wall from below, to a solid from which blocks can be cut.

    Parameters
    ----------
    mesh : TriangleMesh
        The wall, wall frame.
    rows : (r,) int array
        Faces of the part.
    bottom_m : float
        Height z, m, below which the bottom of the solid must lie.

    Returns
    -------
    Solid and (r, 3, 3) array
        The solid, whose first r triangles are the faces `rows` in their order, and the corners of these faces, m.
    """
    used, faces = compact_vertices(mesh.faces[rows])
    vertices = mesh.vertices[used]
    start, end = boundary(faces)
    pinched = np.bincount(start, minlength=len(vertices)) > 1
    if pinched.any():
        vertices, faces = _split_pinched(vertices, faces, pinched)
        start, end = boundary(faces)
    corners = vertices[faces]
    bottom = min(bottom_m, float(vertices[:, 2].min(initial=bottom_m))) - _MARGIN_M
    return solid_of(*_closed(vertices, faces, start, end, bottom), name="wall mesh"), corners


def boundary(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Find the open edges of a mesh with faces (m, 3): those that belong to one face only.

    Returns their start vertices (k,) and end vertices (k,), in the direction in which the face runs.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end).astype(np.int64) << 32 | np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    differs = np.concatenate([[True], np.diff(key[order]) != 0, [True]])
    alone = order[differs[:-1] & differs[1:]]
    return start[alone], end[alone]


def _closed(vertices: FloatArray, faces: IntArray, start: IntArray, end: IntArray, bottom: float) -> tuple[FloatArray, IntArray]:
    """Close a patch from below: add vertical sides and fans; return vertices and faces.

    Parameters
    ----------
    vertices, faces : (n, 3) arrays
        The patch.
    start, end : (k,) arrays
        Vertices of the boundary edges, from start to end.
    bottom : float
        z to which the sides reach, m.
    """
    rim, place = np.unique(np.concatenate([start, end]), return_inverse=True)
    start_low, end_low = (place + len(vertices)).astype(np.int32).reshape(2, -1)
    spread = (np.arange(len(rim))[:, None] * _IRRATIONAL % 1.0 - 0.5) * _SPREAD_M
    low = np.column_stack([vertices[rim, :2] + spread, np.full(len(rim), bottom)])
    loop, apex = _apexes(low, *place.reshape(2, -1))
    top = (len(vertices) + len(rim) + loop).astype(np.int32)
    sides = [(end, start, start_low), (end, start_low, end_low), (end_low, start_low, top)]
    closure = [np.stack(side, axis=1) for side in sides]
    return np.concatenate([vertices, low, apex]), np.concatenate([faces, *closure])


def _apexes(low: FloatArray, start: IntArray, end: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the loop that each edge start -> end belongs to, and for each loop a point below its middle."""
    from scipy import sparse

    graph = sparse.coo_array((np.ones(len(start), dtype=bool), (start, end)), shape=(len(low), len(low)))
    count, loop = sparse.csgraph.connected_components(graph, directed=False)
    size = np.bincount(loop, minlength=count)
    apex = np.stack([np.bincount(loop, low[:, axis], minlength=count) / size for axis in range(3)], axis=1)
    return loop[start], apex - [0.0, 0.0, _MARGIN_M]


def _split_pinched(vertices: FloatArray, faces: IntArray, pinched: NDArray[np.bool_]) -> tuple[FloatArray, IntArray]:
    """Give each fan of faces its own vertex where several boundary loops meet in one."""
    from scipy import sparse

    face, corner = np.nonzero(pinched[faces])
    centre = faces[face, corner].astype(np.int64)
    spokes = [centre << 32 | faces[face, (corner + step) % 3] for step in (1, 2)]
    key, node = np.concatenate(spokes), np.tile(np.arange(len(face)), 2)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)
    links = node[order[same]], node[order[same + 1]]
    graph = sparse.coo_array((np.ones(len(same), dtype=bool), links), shape=(len(face), len(face)))
    _, fan = sparse.csgraph.connected_components(graph, directed=False)
    _, example = np.unique(fan, return_index=True)
    owner = centre[example]
    number = len(vertices) + np.arange(len(owner), dtype=np.int32)
    _, keeps = np.unique(owner, return_index=True)
    number[keeps] = owner[keeps]
    faces = faces.copy()
    faces[face, corner] = number[fan]
    return np.concatenate([vertices, vertices[owner]]), faces


def prism_volumes(vertices: FloatArray, faces: IntArray, base_m: float = 0.0) -> FloatArray:
    """Compute the signed volume (m,), m3, of the vertical prism between each face (m, 3) and the plane z = `base_m`.

    The volume of a closed mesh is their sum (divergence theorem, field (0, 0, z)). `vertices` is (n, 3), m.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    u, v = b - a, c - a
    return (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) * ((a[:, 2] + b[:, 2] + c[:, 2]) / 3 - base_m) / 2
