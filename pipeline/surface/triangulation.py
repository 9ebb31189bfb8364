"""Triangulate the points of a cloud as seen from one place: Delaunay triangles over azimuth and zenith angle.

Unlike a Poisson surface, this surface passes through the points and adds nothing where there are none. It is valid only for
rays from (near) that place. Edges are cut at depth steps, as in grid triangulation (`pipeline.surface.mesh`): where they are
longer in range than a step and nearly along the line of sight. Of the points in one cell of a fine raster of directions, the
one with the median range is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh, signed_volumes
from scene.meshes.rounding import rounded_axes
from sensors.signal_chain.polar import polar

_STEP_M, _STEP_SHARE = 0.1, 0.02
"""Range steps smaller than this, in m and as a share of the range, are never cut."""
_GRAZING_RAD = 0.15
"""Edges at a smaller angle to the line of sight may be cut, rad."""
_LONGEST = 6.0
"""An edge longer than this many typical edges bridges a hole and is cut. Edges along and across scan lines are treated
separately.
"""
_MOST_POINTS = 2_000_000
"""Approximate limit on the number of points that are triangulated."""
_COARSE_M = 5e-3
"""Coordinates rounded to larger steps than this tilt triangles, so their vertices are averaged, m."""
_BETWEEN, _OF_SEVEN = np.sqrt(1 / 2), np.sqrt(1 / 7)
"""Noise midway between two vertices, and noise of the mean of a point and its six neighbours, relative to that of one vertex."""


@dataclass(frozen=True)
class SeenSurface:
    """Store a triangle mesh made from a point cloud as seen from one place.

    Attributes
    ----------
    mesh : TriangleMesh
        In the cloud's frame, m; triangles are counter-clockwise as seen from the viewpoint.
    spacing_m : float
        Median length of its edges, m.
    roughness_m : float
        Robust standard deviation of a point from the mean of its neighbours, m: noise and relief between neighbours.
    smoothed : bool
        Whether each vertex is the mean of its own and its neighbours' points, because the coordinates were coarsely rounded.
    """

    mesh: TriangleMesh
    spacing_m: float
    roughness_m: float
    smoothed: bool

    @property
    def error_m(self) -> float:
        """Estimated standard deviation of the mesh's vertices along the lines of sight, m.

        If vertices are means of neighbouring points (`smoothed`), their errors are correlated. The value is then that of
        independent errors which would make the surface between the vertices equally noisy.
        """
        return float(np.nan_to_num((_OF_SEVEN / _BETWEEN if self.smoothed else 1.0) * self.roughness_m))


def triangulate_seen_points(points: FloatArray, viewpoint: FloatArray, rotation: FloatArray, where: str) -> SeenSurface:
    """Make a triangle mesh from a point cloud as seen from one place, by Delaunay triangulation of the directions.

    Triangles that would bridge a gap are removed: those with an edge across a step in depth, or much longer than the
    typical point spacing.

    Parameters
    ----------
    points : (n, 3) array
        The cloud, m.
    viewpoint : (3,) array
        Position of the sensor, in the cloud's frame, m.
    rotation : (3, 3) array
        Rotation from the scanner's frame to the cloud's frame; directions are angles about the scanner's z axis.
    where : str
        Name of the cloud in error messages.

    Raises
    ------
    InputError
        If all points lie on one line of sight, or all triangles had to be removed.
    """
    from scipy.spatial import Delaunay, QhullError

    local = np.einsum("ij,ni->nj", rotation, points - viewpoint)
    distance, azimuth, zenith = polar(local)
    kept = _one_per_direction(distance, azimuth, zenith)
    local, distance, azimuth, zenith = local[kept], distance[kept], azimuth[kept], zenith[kept]
    plane = _plane(azimuth, zenith)
    try:
        faces = Delaunay(plane).simplices.astype(np.int32)
    except (QhullError, ValueError):
        raise InputError(
            "all points lie on one line of sight, so they span no surface",
            where=where,
            remedy="give the points of a surface, and the place from which they were seen",
        ) from None
    faces = faces[_uncut(local, distance, plane, faces)]
    if not len(faces):
        raise InputError(
            "no triangle between neighbouring points lies on the wall: all span gaps in depth",
            where=where,
            remedy="give a denser cloud, or a triangle mesh instead",
        )
    faces = _towards(faces, local)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    spacing = float(np.median(np.linalg.norm(local[edges[:, 0]] - local[edges[:, 1]], axis=1)))
    smoothed = any(each.step_m > _COARSE_M for each in rounded_axes(points))
    vertices = _averaged(points[kept], edges) if smoothed else points[kept]
    mesh = TriangleMesh(vertices, faces).submesh()
    return SeenSurface(mesh, spacing, _roughness(local, faces, edges), smoothed)


def _averaged(points: FloatArray, edges: NDArray[np.int32]) -> FloatArray:
    """Return the mean (n, 3) of each point and its neighbours. A neighbour along two triangles counts once."""
    ends = np.unique(np.sort(edges, axis=1), axis=0)
    ends = np.concatenate([ends, ends[:, ::-1]])
    count = 1 + np.bincount(ends[:, 0], minlength=len(points))
    origin = points[0]
    local = points - origin
    sums = [column + np.bincount(ends[:, 0], column[ends[:, 1]], minlength=len(points)) for column in local.T]
    return origin + np.stack(sums, axis=1) / count[:, None]


def _one_per_direction(distance: FloatArray, azimuth: FloatArray, zenith: FloatArray) -> NDArray[np.int64]:
    """Select points: in each cell of directions (a third of the median angular spacing) the one with the median range."""
    span = float(np.ptp(azimuth) * np.ptp(zenith))
    cell = max(np.sqrt(span / len(distance)) / 3, np.sqrt(span / (9 * _MOST_POINTS)), 1e-7)
    code = np.floor((azimuth - azimuth.min()) / cell).astype(np.int64) << 32
    code += np.floor((zenith - zenith.min()) / cell).astype(np.int64)
    order = np.lexsort((distance, code))
    starts = np.flatnonzero(np.diff(code[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    return np.sort(order[starts + (counts - 1) // 2])


def _plane(azimuth: FloatArray, zenith: FloatArray) -> FloatArray:
    """Convert angles to lengths on the unit sphere, (n, 2); azimuth starts behind its widest gap."""
    ordered = np.sort(azimuth)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    begin = ordered[(int(np.argmax(gaps)) + 1) % len(ordered)]
    level = np.sin(np.clip(np.median(zenith), 0.1, np.pi - 0.1))
    return np.stack([np.mod(azimuth - begin, 2 * np.pi) * level, zenith], axis=1)


def _uncut(local: FloatArray, distance: FloatArray, plane: FloatArray, faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return the triangles (m,) of which no edge is cut."""
    whole = np.ones(len(faces), dtype=bool)
    pairs = [faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]
    sides = [np.abs(plane[pair[:, 0]] - plane[pair[:, 1]]) for pair in pairs]
    longest = [_LONGEST * _typical(np.concatenate([side[:, axis] for side in sides])) for axis in (0, 1)]
    for pair, side in zip(pairs, sides, strict=True):
        step = np.abs(distance[pair[:, 0]] - distance[pair[:, 1]])
        length = np.linalg.norm(local[pair[:, 0]] - local[pair[:, 1]], axis=1)
        small = step <= np.maximum(_STEP_M, _STEP_SHARE * np.minimum(distance[pair[:, 0]], distance[pair[:, 1]]))
        whole &= small & ((step <= 0.05) | (step <= np.cos(_GRAZING_RAD) * length))
        whole &= (side[:, 0] <= longest[0]) & (side[:, 1] <= longest[1])
    return whole


def _typical(lengths: FloatArray) -> float:
    """Return the median length, ignoring lengths that are only rounding errors."""
    return float(np.median(lengths[lengths > 0.05 * lengths.mean()]))


def _towards(faces: NDArray[np.int32], local: FloatArray) -> NDArray[np.int32]:
    """Wind the faces counter-clockwise as seen from the origin of the local frame."""
    away = signed_volumes(local[faces]) > 0
    faces = faces.copy()
    faces[away] = faces[away][:, ::-1]
    return faces


def _roughness(local: FloatArray, faces: NDArray[np.int32], edges: NDArray[np.int32]) -> float:
    """Return the robust standard deviation along the rays of a vertex from the mean of its neighbours.

    It is divided by sqrt(1 + 1 / k), the factor by which the mean of k neighbours increases a vertex's own noise.
    """
    ends = np.concatenate([edges, edges[:, ::-1]])
    count = np.bincount(ends[:, 0], minlength=len(local))
    inner = count >= 8  # four neighbours, each edge seen from two triangles
    if not inner.any():
        return float("nan")
    sums = [np.bincount(ends[:, 0], column[ends[:, 1]], minlength=len(local)) for column in local.T]
    apart = (local - np.stack(sums, axis=1) / np.maximum(count, 1)[:, None])[inner]
    normal = TriangleMesh(local, faces).vertex_normals()[inner]
    facing = np.einsum("ni,ni->n", local[inner], normal) / np.linalg.norm(local[inner], axis=1)
    off = np.einsum("ni,ni->n", apart, normal) / np.minimum(facing, -0.1) / np.sqrt(1 + 2 / count[inner])
    return float(1.4826 * np.median(np.abs(off - np.median(off))))
