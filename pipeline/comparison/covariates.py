"""Compute what noise may depend on, for each pixel of the wall.

The covariates are range, incidence angle, distance from edges, albedo and visibility.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.precision.surface import Places, visible_from
from scene.common.backend import dr
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster

BoolArray = NDArray[np.bool_]
Raster = NDArray[np.float32]
_EDGE_SLOPE = 4.0
"""Height difference of neighbouring pixels over their distance that makes an edge: a slope of 76 degrees from the
wall's plane.
"""
_LEAST_STEP_M = 0.05
"""Smallest height difference of an edge, m."""


@dataclass(frozen=True)
class UntouchedWall:
    """The wall before any rockfall, sampled at every pixel of a raster, with properties on which noise may depend.

    Attributes
    ----------
    grid : The raster.
    points : (h, w, 3) points on the wall, wall frame, m; NaN without a surface.
    normals : (h, w, 3) unit normals, wall frame.
    albedo : (h, w) albedo (share of light reflected), 0 to 1; NaN without a surface.
    edge_m : (h, w) distance in the wall's plane from the nearest step of the rock surface, m.
    found : (h, w) true where there is a surface.
    """

    grid: Grid
    points: FloatArray
    normals: Raster
    albedo: Raster
    edge_m: Raster
    found: BoolArray


def untouched_wall(caster: RayCaster, grid: Grid) -> UntouchedWall:
    """Sample the wall before any rockfall at every pixel of a raster: points, normals, albedo and distance from edges.

    caster: the wall, for ray casting along -z of the wall frame. grid: the raster, in the wall's plane.
    """
    hits, point = caster.look_down(grid)
    valid, normal, albedo = hits.valid, hits.normal, hits.albedo
    dr.eval(valid, point, normal, albedo)
    found = np.array(valid).reshape(grid.shape)
    points = np.array(point).T.reshape(*grid.shape, 3)
    normals = np.array(normal, dtype=np.float32).T.reshape(*grid.shape, 3)
    points[~found] = np.nan
    return UntouchedWall(
        grid,
        points,
        normals,
        np.where(found, np.array(albedo).reshape(grid.shape), np.nan).astype(np.float32),
        edge_distance(points[..., 2], grid.gsd),
        found,
    )


def edge_distance(heights: NDArray[np.floating], gsd_m: float) -> Raster:
    """Compute the distance of each pixel from the nearest edge (step) of the rock, near which noise is larger.

    An edge lies between neighbouring pixels whose heights differ by more than four pixel sizes and by more than 5 cm.

    Parameters
    ----------
    heights : (h, w) heights above the wall's plane, m.
    gsd_m : Pixel size, m.

    Returns
    -------
    (h, w) distances in the wall's plane between pixel centres, m; infinite if there is no edge.
    """
    limit = max(_EDGE_SLOPE * gsd_m, _LEAST_STEP_M)
    edge = np.zeros(heights.shape, dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(heights, axis=axis)) > limit
        first, second = (edge[:-1], edge[1:]) if axis == 0 else (edge[:, :-1], edge[:, 1:])
        first |= step
        second |= step
    if not edge.any():
        return np.full(heights.shape, np.inf, dtype=np.float32)
    return (gsd_m * ndimage.distance_transform_edt(~edge)).astype(np.float32)


def range_and_incidence(wall: UntouchedWall, viewpoints: Sequence[FloatArray]) -> tuple[Raster, Raster]:
    """Compute range and incidence angle at every pixel of a wall, averaged over the positions from which a sensor observes it.

    Parameters
    ----------
    wall : The wall before any rockfall, at every pixel.
    viewpoints : Positions (3,), wall frame, m: the scanner's stations, or the two cameras.

    Returns
    -------
    (h, w) ranges, m, and (h, w) angles between line of sight and surface normal, rad; NaN without a surface.
    """
    ranges, angles = [], []
    for viewpoint in viewpoints:
        sight = viewpoint - wall.points
        distance = np.linalg.norm(sight, axis=-1)
        cosine = np.einsum("hwi,hwi->hw", sight, wall.normals) / distance
        ranges.append(distance)
        angles.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.mean(ranges, axis=0).astype(np.float32), np.mean(angles, axis=0).astype(np.float32)


def visible(wall: UntouchedWall, caster: RayCaster, viewpoints: Sequence[FloatArray], *, every: bool) -> BoolArray:
    """Find the pixels of the wall that a sensor can see, where no rock is in the way.

    Parameters
    ----------
    wall : The wall before any rockfall, at every pixel.
    caster : The same wall, for ray casting.
    viewpoints : Positions (3,), wall frame, m: the scanner's stations, or the two cameras.
    every : True if a pixel must be visible from every viewpoint, as for a stereo pair; false if one is enough.

    Returns
    -------
    (h, w) true for visible pixels.
    """
    places = Places(
        wall.points[wall.found], wall.normals[wall.found].astype(np.float64), wall.albedo[wall.found].astype(np.float64)
    )
    seen = np.stack([visible_from(caster, places, viewpoint) for viewpoint in viewpoints])
    result = np.zeros(wall.found.shape, dtype=bool)
    result[wall.found] = seen.all(axis=0) if every else seen.any(axis=0)
    return result
