"""Carve blocks out of a wall with Manifold. Only the patches under the blocks are processed; the rest of the wall is copied."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene.blocks.block import Blocks
from scene.blocks.slivers import remove_slivers
from scene.blocks.solid import Piece, boundary, close_patch, prism_volumes, read_piece, solid_of, split_wall
from scene.common.errors import InputError
from scene.geometry.mesh import WALL, FloatArray, IntArray, TriangleMesh, area_normals
from scene.geometry.under_boxes import faces_under_boxes

FRESH_ALBEDO = 0.6
"""Albedo of freshly exposed rock, not yet darkened by weathering."""

_HALO_M = 1e-3
"""Margin around the blocks' boxes, so that slivers at the rims always have complete neighbourhoods."""

_CHUNK = 1 << 15
"""Number of faces processed at a time, so that what is computed stays in the processor's cache."""


@dataclass(frozen=True)
class Carved:
    """A wall after its blocks have been cut out, with the volumes of rock that were removed.

    Attributes
    ----------
    mesh : TriangleMesh
        The surface. `face_block` is the label (1 to k) of the block whose niche a face belongs to, WALL (0) elsewhere.
        `vertex_block` is the same for vertices inside niches; vertices on a rim, which also lie on the old surface, are WALL.
    removed_volume_m3 : (k,) array
        Volume of rock that each block removed. It includes the small change of volume by which slivers (needle-shaped
        triangles) at the rim of the niche were removed.
    wall_volume_m3 : float
        Volume of the wall before carving; for an open surface the volume above its lowest point.
    balance_m3 : float
        Volume before minus volume after minus the sum of the removed volumes: 0 except for rounding.
    """

    mesh: TriangleMesh
    removed_volume_m3: FloatArray
    wall_volume_m3: float
    balance_m3: float


@dataclass(frozen=True)
class BlockMeshes:
    """The meshes that show how one block is cut out of the wall, wall frame.

    Attributes
    ----------
    wall_difference : TriangleMesh
        The wall around the block, with the hole.
    intersection : TriangleMesh
        The closed solid of rock that is removed. Its `face_block` is WALL (0) on the wall's surface and the block's label on
        the block's side.
    niche : TriangleMesh
        The surface left in the wall.
    removed_block : TriangleMesh
        The closed part of the block that protrudes from the wall, for display alone.
    """

    wall_difference: TriangleMesh
    intersection: TriangleMesh
    niche: TriangleMesh
    removed_block: TriangleMesh


@dataclass(frozen=True)
class _Surface:
    """The carved patches before they are inserted into the wall.

    Attributes
    ----------
    label : (m,) array
        Block label of each face: up to `earlier` those of the wall before this carving, above it those of the new niches.
    origin : (n,) array
        Index of the wall's vertex that each vertex comes from; -1 for a new one.
    """

    vertices: FloatArray
    faces: IntArray
    label: IntArray
    origin: IntArray
    albedo: NDArray[np.float32] | None
    earlier: int = WALL

    @property
    def is_niche(self) -> NDArray[np.bool_]:
        """(m,) whether a face belongs to a new niche."""
        return np.asarray(self.label > self.earlier)


def carve(mesh: TriangleMesh, blocks: Blocks, fresh_albedo: float = FRESH_ALBEDO, first_label: int | None = None) -> Carved:
    """Cut blocks out of a wall, open or closed, so that a niche remains of each. An open wall keeps its boundary loops.

    Parameters
    ----------
    mesh : TriangleMesh
        The wall, wall frame.
    blocks : Blocks
        Disjoint blocks, wall frame.
    fresh_albedo : float
        Albedo (0 to 1) of the niches, if the wall has an albedo.
    first_label : int, optional
        Label of the first block's niche; the others follow. Smaller labels from earlier carvings are then kept. None: labels
        from 1 on, and earlier labels become WALL (0).

    Returns
    -------
    Carved
        The wall with niches, and the removed volumes.

    Raises
    ------
    InputError
        If the wall is not manifold near a block, or if a block removes nothing.
    """
    rows = faces_under_boxes(mesh, blocks.bbox, _HALO_M)
    wall, corners = close_patch(mesh, rows, float(blocks.bbox[:, 0, 2].min()))
    removed, left = split_wall(wall, solid_of(blocks.vertices, blocks.faces, "blocks"))
    kept = mesh if first_label is not None else replace(mesh, vertex_block=None, face_block=None)
    surface, gain = _without_slivers(_surface(kept, rows, corners, left, blocks, fresh_albedo, (first_label or 1) - 1))
    volumes = _removed_volumes(removed, blocks) - gain[surface.earlier + 1 :]
    carved = _put_back(kept, rows, surface)
    low = float(mesh.vertices[:, 2].min())
    before = _volume(mesh.vertices, mesh.faces, low)
    return Carved(carved, volumes, before, before - _volume(carved.vertices, carved.faces, low) - float(volumes.sum()))


def block_records(blocks: Blocks, removed_volume_m3: FloatArray) -> list[dict[str, Any]]:
    """Make the record of each block for the file blocks.json: label, shape, sizes, removed volume and place.

    All values are in SI units; bounding box and position are in the wall frame. `removed_volume_m3` is (k,): the volume of rock
    that each of the k blocks removed.
    """
    return [
        {
            "label": index + 1,
            "shape": blocks.shape[index],
            "size_m": blocks.size_m[index].tolist(),
            "volume_m3": float(removed_volume_m3[index]),
            "bbox_m": blocks.bbox[index].ravel().tolist(),
            "position_m": blocks.position_m[index].tolist(),
        }
        for index in range(len(blocks))
    ]


def block_meshes(mesh: TriangleMesh, blocks: Blocks, index: int) -> BlockMeshes:
    """Compute the meshes that show how one block is cut out of the wall, such as the niche and the removed rock.

    Only the part of the wall around the block is used.

    Parameters
    ----------
    mesh : TriangleMesh
        The intact wall, wall frame.
    blocks : Blocks
        All blocks.
    index : int
        Index of the block, from 0. The meshes carry its block label, index + 1.
    """
    block = blocks.only(index)
    rows = faces_under_boxes(mesh, block.bbox, _HALO_M)
    wall, _ = close_patch(mesh, rows, float(block.bbox[0, 0, 2]))
    cutter = solid_of(block.vertices, block.faces, "blocks")
    removed, left = split_wall(wall, cutter)
    outside = read_piece(cutter.manifold - wall.manifold, cutter)
    label = index + 1
    return BlockMeshes(
        wall_difference=_part(left, left.first & (left.source < len(rows)), WALL),
        intersection=_part(removed, np.ones(len(removed.faces), dtype=bool), np.where(removed.first, WALL, label)),
        niche=_part(left, ~left.first, label),
        removed_block=_part(outside, np.ones(len(outside.faces), dtype=bool), np.where(outside.first, label, WALL)),
    )


def _part(whole: Piece, chosen: NDArray[np.bool_], label: int | IntArray) -> TriangleMesh:
    """Return some faces of a boolean's result as a mesh with block labels."""
    labels = np.broadcast_to(np.asarray(label, dtype=np.int32), len(chosen))
    return TriangleMesh(whole.vertices, whole.faces, face_block=labels).submesh(chosen)


def removed_rocks(mesh: TriangleMesh, blocks: Blocks) -> TriangleMesh:
    """Return the rocks that disjoint blocks cut out of a wall, each as a closed mesh in its place, wall frame.

    A rock is the part of a block that lies inside the wall. `face_block` and `vertex_block` are the label (1 to k) of the rock.
    Albedo is that of the nearest vertex of the wall on the wall's surface and that of fresh rock elsewhere, if the wall has an
    albedo.
    """
    rows = faces_under_boxes(mesh, blocks.bbox, _HALO_M)
    wall, _ = close_patch(mesh, rows, float(blocks.bbox[:, 0, 2].min()))
    removed, _ = split_wall(wall, solid_of(blocks.vertices, blocks.faces, "blocks"))
    label, component = _components(removed, blocks)
    face_block = label[component].astype(np.int32)
    vertex_block = np.full(len(removed.vertices), WALL, dtype=np.int32)
    vertex_block[removed.faces] = face_block[:, None]
    albedo = None
    if mesh.vertex_albedo is not None:
        from scipy.spatial import cKDTree

        front = np.unique(removed.faces[removed.first])
        near = np.unique(mesh.faces[rows])
        albedo = np.full(len(removed.vertices), FRESH_ALBEDO, dtype=np.float32)
        albedo[front] = mesh.vertex_albedo[near][cKDTree(mesh.vertices[near]).query(removed.vertices[front])[1]]
    return TriangleMesh(removed.vertices, removed.faces, albedo, vertex_block, face_block).submesh()


def _components(removed: Piece, blocks: Blocks) -> tuple[NDArray[np.int64], IntArray]:
    """Return the block's label (c,) of each connected part of what was removed, and the part (m,) of each face."""
    from scipy import sparse

    links = removed.faces[:, [0, 1]].T, removed.faces[:, [1, 2]].T
    rows, columns = np.concatenate(links, axis=1)
    graph = sparse.coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(len(removed.vertices),) * 2)
    count, component = sparse.csgraph.connected_components(graph, directed=False)
    component = component[removed.faces[:, 0]]
    label = np.zeros(count, dtype=np.int64)
    label[component[~removed.first]] = blocks.face_label[removed.source[~removed.first]]
    whole = np.flatnonzero(label == 0)  # pieces of wall entirely inside a block, which contain no face of it
    label[whole] = _containing(blocks, removed, component, whole)
    return label, component


def _removed_volumes(removed: Piece, blocks: Blocks) -> FloatArray:
    """Return the volume (k,) of the intersection with each block. Raises InputError for a block that removes nothing."""
    label, component = _components(removed, blocks)
    parts = prism_volumes(removed.vertices, removed.faces)
    volumes = np.bincount(label[component], parts, minlength=len(blocks) + 1)[1:].astype(np.float64)
    nothing = np.flatnonzero(volumes <= 0)
    if len(nothing):
        x, y, z = blocks.position_m[nothing[0]]
        raise InputError(
            f"{len(nothing)} of {len(blocks)} blocks remove no rock, the first of them at ({x:.2f}, {y:.2f}, {z:.2f}) m",
            where="carving",
            remedy="place the blocks on the surface of the wall, whose triangles must face the sensors (+z)",
        )
    return volumes


def _containing(blocks: Blocks, removed: Piece, component: IntArray, wanted: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the label of the block whose bounding box contains each wanted component."""
    example = np.array([removed.faces[np.argmax(component == number), 0] for number in wanted], dtype=np.intp)
    points = removed.vertices[example][:, None]
    inside = np.all((points >= blocks.bbox[None, :, 0]) & (points <= blocks.bbox[None, :, 1]), axis=2)
    return inside.argmax(axis=1) + 1


def _surface(
    mesh: TriangleMesh,
    rows: IntArray,
    corners: FloatArray,
    left: Piece,
    blocks: Blocks,
    fresh_albedo: float,
    earlier: int,
) -> _Surface:
    """Collect the remaining patches and the niches, and find the wall's vertices by their source faces.

    The closure at the back of the patch is left out. Arguments as in `carve`; `earlier` is the largest label before it.
    """
    is_wall = left.first & (left.source < len(rows))
    chosen = is_wall | ~left.first
    faces, source, is_wall = left.faces[chosen], left.source[chosen], is_wall[chosen]
    label = np.full(len(faces), WALL, dtype=np.int32)
    label[~is_wall] = earlier + blocks.face_label[source[~is_wall]]
    if mesh.face_block is not None:
        label[is_wall] = mesh.face_block[rows[source[is_wall]]]
    wall_faces, source = faces[is_wall], source[is_wall]
    position = left.vertices[wall_faces]
    origin = np.full(len(left.vertices), -1, dtype=np.int32)
    for number in range(3):
        face, corner = np.nonzero(np.all(position == corners[source, None, number], axis=2))
        origin[wall_faces[face, corner]] = mesh.faces[rows[source[face]], number]
    if mesh.vertex_albedo is None:
        return _Surface(left.vertices, faces, label, origin, None, earlier)
    albedo = np.full(len(origin), fresh_albedo, dtype=np.float32)
    face, corner = np.nonzero(origin[wall_faces] < 0)
    weights = _barycentric(corners[source[face]], position[face, corner])
    albedo[wall_faces[face, corner]] = np.einsum("ni,ni->n", weights, mesh.vertex_albedo[mesh.faces[rows[source[face]]]])
    return _Surface(left.vertices, faces, label, origin, albedo, earlier)


def _barycentric(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Return the weights (n, 3) of the corners (n, 3, 3) at points (n, 3) in their triangles, within [0, 1]."""
    to_corner = corners - points[:, None]
    normal = area_normals(corners)
    parts = np.cross(np.roll(to_corner, -1, axis=1), np.roll(to_corner, -2, axis=1))
    weights = np.clip(np.einsum("nij,nj->ni", parts, normal), 0.0, None)
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)


def _without_slivers(surface: _Surface) -> tuple[_Surface, FloatArray]:
    """Remove slivers along the rims; return the surface and the volume that this adds, by label.

    Vertices on the patches' boundary stay.
    """
    of_wall, of_niche = (_used(surface, is_wall) for is_wall in (True, False))
    rank = np.ones(len(surface.vertices), dtype=np.int8)
    rank[of_wall & (of_niche | (surface.origin < 0))] = 2
    rank[boundary(surface.faces)[0]] = 0
    mended = remove_slivers(surface.vertices, surface.faces, surface.label, rank)
    return replace(surface, faces=mended.faces, label=mended.label), mended.gain_m3


def _used(surface: _Surface, is_wall: bool) -> NDArray[np.bool_]:
    """Return which vertices (n,) belong to wall faces, or to niche faces."""
    used = np.zeros(len(surface.vertices), dtype=bool)
    used[surface.faces[surface.is_niche != is_wall].ravel()] = True
    return used


def _put_back(mesh: TriangleMesh, rows: IntArray, surface: _Surface) -> TriangleMesh:
    """Join the untouched faces, in their order, and the faces of the carved patches, with only the vertices still in use."""
    untouched = np.ones(len(mesh.faces), dtype=bool)
    untouched[rows] = False
    on_wall, on_niche = _used(surface, True), _used(surface, False)
    new = np.flatnonzero((on_wall | on_niche) & (surface.origin < 0))
    number = surface.origin.copy()
    number[new] = len(mesh.vertices) + np.arange(len(new), dtype=np.int32)
    faces = np.concatenate([mesh.faces[untouched], number[surface.faces]])
    face_block = np.full(len(faces), WALL, dtype=np.int32)
    if mesh.face_block is not None:
        face_block[: len(faces) - len(surface.faces)] = mesh.face_block[untouched]
    face_block[len(faces) - len(surface.faces) :] = surface.label
    vertex_block = np.full(len(mesh.vertices) + len(new), WALL, dtype=np.int32)
    if mesh.vertex_block is not None:
        vertex_block[: len(mesh.vertices)] = mesh.vertex_block
    niche = surface.is_niche
    vertex_block[number[surface.faces[niche]]] = surface.label[niche, None]
    vertex_block[number[on_wall & on_niche]] = WALL  # the rims
    vertices, albedo = np.concatenate([mesh.vertices, surface.vertices[new]]), None
    if surface.albedo is not None and mesh.vertex_albedo is not None:
        albedo = np.concatenate([mesh.vertex_albedo, surface.albedo[new]])
    return TriangleMesh(vertices, faces, albedo, vertex_block, face_block).submesh()


def _volume(vertices: FloatArray, faces: IntArray, base_m: float) -> float:
    """Return the volume between a surface and z = base_m; for a closed surface its volume, whatever the base."""
    starts = range(0, len(faces), _CHUNK)
    return float(sum(prism_volumes(vertices, faces[start : start + _CHUNK], base_m).sum() for start in starts))
