"""The wall as a planner sees it: a raster of places with normals, and which of them a viewpoint sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import vectors_on_device
from sensors.numerics.device import vector
from sensors.stereo.stereo_pair import SHADOW_MARGIN

_PIXELS = 1e5
"""Pixels of a map whose GSD is left open; on a wall of 70 x 45 m they measure 18 cm."""
_MOST_PIXELS = 2e7
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Places:
    """n places on a surface, wall frame. points: (n, 3), m; normals: (n, 3) unit, outside; albedo: (n,)."""

    points: FloatArray
    normals: FloatArray
    albedo: FloatArray

    def at(self, chosen: BoolArray) -> Places:
        """Return some of the places: a mask (n,)."""
        return Places(self.points[chosen], self.normals[chosen], self.albedo[chosen])


@dataclass(frozen=True)
class WallRaster:
    """The wall looked at along -z. found: (height, width), where there is a surface; places: of those n pixels, row by row."""

    grid: Grid
    found: BoolArray
    places: Places

    def image(self, values: NDArray[np.generic]) -> FloatArray:
        """(height, width) the n values at their pixels, NaN where there is no surface."""
        result = np.full(self.grid.shape, np.nan)
        result[self.found] = values
        return result


def wall_raster(caster: RayCaster, gsd_m: float | None = None) -> WallRaster:
    """Sample a wall (wall frame) at the pixels of a grid; without `gsd_m` the grid has some 100,000 of them.

    Raises InputError for a GSD larger than the wall or so fine that the maps have more than 20 million pixels.
    """
    bounds = caster.mesh.bounds
    extent = bounds[1, :2] - bounds[0, :2]
    gsd = gsd_m or float(np.sqrt(extent.prod() / _PIXELS))
    finest, coarsest = float(np.sqrt(extent.prod() / _MOST_PIXELS)), float(extent.min())
    if not finest <= gsd <= coarsest:
        raise InputError(
            f"a pixel of {gsd:g} m does not suit a wall of {extent[0]:.1f} x {extent[1]:.1f} m",
            where="planning.gsd_m",
            allowed=f"{finest:.2g} to {coarsest:.3g} m",
        )
    grid = Grid.over(bounds, gsd)
    hits, point = caster.look_down(grid)
    valid, normal, albedo = hits.valid, hits.normal, hits.albedo
    dr.eval(valid, point, normal, albedo)
    found = np.array(valid)
    if not found.any():
        raise InputError("its surface is not seen along its mean plane's normal", where="wall", remedy="check the mesh")
    points, normals = (np.array(array, dtype=np.float64).T[found] for array in (point, normal))
    places = Places(points, normals, np.array(albedo, dtype=np.float64)[found])
    return WallRaster(grid, found.reshape(grid.shape), places)


def seen_from(caster: RayCaster, places: Places, viewpoint: FloatArray) -> BoolArray:
    """(n,) whether each place turns its front to `viewpoint` ((3,), m) with nothing in between."""
    facing = np.einsum("ni,ni->n", places.normals, places.points - viewpoint) < 0
    origin = vector(viewpoint)
    sight = vectors_on_device(places.points) - origin
    hidden = caster.occluded(origin, sight, dr.opaque(mi.Float64, 1.0 - SHADOW_MARGIN), coherent=False)
    return facing & ~np.array(hidden)


def turned(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    """(n, 3) `matrix` (3, 3) times each of the vectors (n, 3)."""
    return np.einsum("ij,nj->ni", matrix, vectors)


def slide(ray: FloatArray, turn: FloatArray, normals: FloatArray) -> FloatArray:
    """(n, 3) how far the point of a tangent plane that a ray hits moves when the ray changes.

    The ray is c + t r, the plane's normal n: dp = t (dr - r (n . dr) / (n . r)).
    ray: (n, 3), t r, from the centre to the surface; turn: (n, 3), t dr.
    """
    along = np.einsum("ni,ni->n", normals, turn) / np.einsum("ni,ni->n", normals, ray)
    return turn - ray * along[:, None]
