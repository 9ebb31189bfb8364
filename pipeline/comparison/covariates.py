"""What noise may depend on, pixel by pixel: range, incidence, distance from edges, albedo; and what a sensor can see at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.precision.surface import Places, seen_from
from scene.common.backend import dr
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster

BoolArray = NDArray[np.bool_]
Raster = NDArray[np.float32]
_EDGE_SLOPE = 4.0
"""Rise over run between neighbouring pixels that makes an edge: the surface turns 76 degrees from the wall's plane."""
_LEAST_STEP_M = 0.05


@dataclass(frozen=True)
class Ground:
    """The untouched wall at every pixel of a grid; all (h, w), NaN or False where there is no surface.

    points: (h, w, 3), normals: (h, w, 3) unit, wall frame, m; albedo; edge_m: distance in the wall's plane from the nearest edge,
    where neighbouring pixels differ in z by more than four pixels and 5 cm; found: where there is a surface.
    """

    grid: Grid
    points: FloatArray
    normals: Raster
    albedo: Raster
    edge_m: Raster
    found: BoolArray


def ground(caster: RayCaster, grid: Grid) -> Ground:
    """Look at the untouched wall (wall frame) along -z at every pixel centre."""
    hits, point = caster.look_down(grid)
    valid, normal, albedo = hits.valid, hits.normal, hits.albedo
    dr.eval(valid, point, normal, albedo)
    found = np.array(valid).reshape(grid.shape)
    points = np.array(point).T.reshape(*grid.shape, 3)
    normals = np.array(normal, dtype=np.float32).T.reshape(*grid.shape, 3)
    points[~found] = np.nan
    return Ground(
        grid,
        points,
        normals,
        np.where(found, np.array(albedo).reshape(grid.shape), np.nan).astype(np.float32),
        edge_distance(points[..., 2], grid.gsd),
        found,
    )


def edge_distance(heights: NDArray[np.floating], gsd_m: float) -> Raster:
    """(h, w) distance, m, of each pixel's centre from the nearest one beside an edge; infinite where there is no edge."""
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


def range_and_incidence(on: Ground, viewpoints: Sequence[FloatArray]) -> tuple[Raster, Raster]:
    """(h, w) mean distance from the viewpoints ((3,), wall frame), m, and mean angle between sight and normal, rad."""
    ranges, angles = [], []
    for viewpoint in viewpoints:
        sight = viewpoint - on.points
        distance = np.linalg.norm(sight, axis=-1)
        cosine = np.einsum("hwi,hwi->hw", sight, on.normals) / distance
        ranges.append(distance)
        angles.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.mean(ranges, axis=0).astype(np.float32), np.mean(angles, axis=0).astype(np.float32)


def visible(on: Ground, caster: RayCaster, viewpoints: Sequence[FloatArray], *, every: bool) -> BoolArray:
    """(h, w) where the surface is seen from every viewpoint, as a stereo pair needs it, or from any."""
    places = Places(on.points[on.found], on.normals[on.found].astype(np.float64), on.albedo[on.found].astype(np.float64))
    seen = np.stack([seen_from(caster, places, viewpoint) for viewpoint in viewpoints])
    result = np.zeros(on.found.shape, dtype=bool)
    result[on.found] = seen.all(axis=0) if every else seen.any(axis=0)
    return result
