"""Which side of a surface is its outside: that which the sensors see."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh, signed_volumes
from scene.meshes.cleaning import Mended, flipped, groups, weld, wound_otherwise
from scene.ray_casting.raycast import RayCaster

_FARTHEST_M = 1e5
"""No sensor for rock walls looks farther."""
_GEOCENTRIC_M = 6.3e6, 6.5e6
"""How far from the earth's centre sensors on its surface stand."""


def facing(mesh: TriangleMesh, viewpoints: list[FloatArray], where: str, *, cleaned: bool = False) -> Mended:
    """The mesh wound one way in each connected piece, and counter-clockwise seen from the sensors; and what was turned, in words.

    viewpoints: (3,) each, the mesh's frame, near its origin. A piece that shows most of its back is turned. Vertices stay.
    cleaned: it is welded and its pieces are wound one way, as `clean` leaves them. Raises InputError for a surface with one side,
    and for a closed solid that is seen from within.
    """
    welded, words = mesh, []
    if not cleaned:
        welded = weld(mesh)[0]
        odd = wound_otherwise(welded, where)
        mesh, welded = flipped(mesh, odd), flipped(welded, odd)
        words = [f"{int(odd.sum())} triangles wound the other way round"] if odd.any() else []
    backs = _pieces_seen_from_behind(mesh, welded, viewpoints, where)
    if backs.any():
        mesh = flipped(mesh, backs)
        part = "all" if backs.all() else "a piece of"
        words.append(f"{part} {int(backs.sum())} triangles turned, as they were wound away from the sensor")
    return mesh, "; ".join(words)


def check_near(vertices: FloatArray, viewpoints: Mapping[str, FloatArray], where: str) -> None:
    """Raise InputError where a sensor stands so far from the surface that the two cannot be in one coordinate system.

    vertices: (n, 3) and viewpoints: (3,) by name, world frame.
    """
    centre = vertices.mean(axis=0)
    for name, position in viewpoints.items():
        distance = float(np.linalg.norm(position - centre))
        if distance <= _FARTHEST_M + float(np.ptp(vertices, axis=0).max()):
            continue
        geocentric = _GEOCENTRIC_M[0] < np.linalg.norm(position) < _GEOCENTRIC_M[1]
        raise InputError(
            f"{name} stands {distance / 1e3:,.0f} km from the surface"
            + (", in geocentric coordinates" if geocentric else ": the two are not in one coordinate system"),
            where=where,
            allowed=f"up to {_FARTHEST_M / 1e3:.0f} km",
            remedy="export the surface and the poses in one and the same local or projected coordinate system",
        )


def _pieces_seen_from_behind(
    mesh: TriangleMesh, welded: TriangleMesh, viewpoints: list[FloatArray], where: str
) -> NDArray[np.bool_]:
    """(m,) the triangles of the pieces that are to be turned."""
    scene = RayCaster(mesh)
    seen = [scene.sides_seen(position) for position in viewpoints]
    face, behind = (np.concatenate(each) for each in zip(*seen, strict=True))
    if not behind.any():
        return np.zeros(len(mesh.faces), bool)
    piece = groups(welded.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(welded.vertices))[welded.faces[:, 0]]
    count = int(piece.max()) + 1
    backs = np.bincount(piece[face], np.where(behind, 1, -1), count) > 0
    if not backs.any():
        return np.zeros(len(mesh.faces), bool)
    if (backs & _is_whole(welded, piece, count)).any():
        raise InputError(
            "the sensor stands inside a closed solid of the surface",
            where=where,
            allowed="a place from which the outside of each closed solid is seen",
            remedy="check the sensor's position, or cut the surface open",
        )
    return backs[piece]


def _is_whole(mesh: TriangleMesh, piece: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """(count,) pieces that are closed and wound counter-clockwise seen from outside: their signed volume is above 0."""
    _, inverse, uses = np.unique(mesh.edges, return_inverse=True, return_counts=True)
    rim = np.bincount(np.tile(piece, 3), uses[inverse] == 1, count)
    volume = signed_volumes(mesh.corners() - mesh.vertices.mean(axis=0))
    return (rim == 0) & (np.bincount(piece, volume, count) > 0)
