"""Orient a surface so that its outer side is the one that the sensors see, and check that sensors and surface belong together."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh, signed_volumes
from scene.meshes.cleaning import Repaired, connected_groups, flip_faces, inconsistent_faces, weld
from scene.ray_casting.raycast import RayCaster

_FARTHEST_M = 1e5
"""No sensor for rock walls measures farther than this."""
_GEOCENTRIC_M = 6.3e6, 6.5e6
"""Smallest and largest distance of sensors on the earth's surface from its centre."""
CHECK_SIDE = "check that the sensor stands in front of the wall, not behind it"
"""What a user should do if every triangle had to be turned: either the mesh or the sensor's position is wrong."""


def orient_to_sensors(
    mesh: TriangleMesh, viewpoints: list[FloatArray], where: str, *, cleaned: bool = False, scene: RayCaster | None = None
) -> Repaired:
    """Order the corners of all triangles counter-clockwise as seen from the sensors, so that normals point to them.

    Each connected piece of the mesh that mostly shows its back is flipped. Vertices do not change.

    Parameters
    ----------
    mesh : TriangleMesh
        The surface.
    viewpoints : list of (3,) arrays
        Positions of the sensors in the mesh's frame, near its origin, m.
    where : str
        Name of the mesh in error messages.
    cleaned : bool
        Whether the mesh is already welded and consistently wound, as `clean` leaves it.
    scene : RayCaster, optional
        A ray caster of this mesh, if there is one.

    Returns
    -------
    TriangleMesh, str
        The mesh, and what was flipped, in words.

    Raises
    ------
    InputError
        If the surface has only one side, or if a sensor stands inside a closed solid.
    """
    welded, words = mesh, []
    if not cleaned:
        welded = weld(mesh)[0]
        odd = inconsistent_faces(welded, where)
        if odd.any():
            mesh, welded = flip_faces(mesh, odd), flip_faces(welded, odd)
            words = [f"{int(odd.sum())} triangles wound the other way round"]
    scene = scene if scene is not None and scene.mesh is mesh else RayCaster(mesh)
    backs = _pieces_seen_from_behind(scene, welded, viewpoints, where)
    if backs.any():
        mesh = flip_faces(mesh, backs)
        part, remedy = ("all", f"; {CHECK_SIDE}") if backs.all() else ("a piece of", "")
        words.append(f"{part} {int(backs.sum())} triangles turned, as they were wound away from the sensor{remedy}")
    return mesh, "; ".join(words)


def check_distances(vertices: FloatArray, viewpoints: Mapping[str, FloatArray], where: str) -> None:
    """Check that sensors and surface are in one coordinate system: raise InputError if a sensor is implausibly far away.

    Parameters
    ----------
    vertices : (n, 3) array
        The surface, world frame, m.
    viewpoints : mapping of str to (3,) array
        Positions of the sensors by name, world frame, m.
    where : str
        Name of the surface in the message.
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
    scene: RayCaster, welded: TriangleMesh, viewpoints: list[FloatArray], where: str
) -> NDArray[np.bool_]:
    """Return the triangles (m,) of the scene's mesh that belong to pieces that have to be flipped."""
    seen = [scene.sides_seen(position) for position in viewpoints]
    face, behind = (np.concatenate(each) for each in zip(*seen, strict=True))
    if not behind.any():
        return np.zeros(len(welded.faces), bool)
    piece = connected_groups(welded.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(welded.vertices))[welded.faces[:, 0]]
    count = int(piece.max()) + 1
    backs = np.bincount(piece[face], np.where(behind, 1, -1), count) > 0
    if not backs.any():
        return np.zeros(len(welded.faces), bool)
    if (backs & _is_outward_solid(welded, piece, count)).any():
        raise InputError(
            "the sensor stands inside a closed solid of the surface",
            where=where,
            allowed="a place from which the outside of each closed solid is seen",
            remedy="move the sensor's position out of the solid, or cut the surface open in a mesh editor",
        )
    return backs[piece]


def _is_outward_solid(mesh: TriangleMesh, piece: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Return which pieces (count,) are closed solids with outward normals, that is with a positive signed volume."""
    _, inverse, uses = np.unique(mesh.edges, return_inverse=True, return_counts=True)
    rim = np.bincount(np.tile(piece, 3), uses[inverse] == 1, count)
    volume = signed_volumes(mesh.corners() - mesh.vertices.mean(axis=0))
    return (rim == 0) & (np.bincount(piece, volume, count) > 0)
