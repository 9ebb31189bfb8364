"""Sample the wall for planning: a raster of places with normals, and which of them a viewpoint sees."""

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
"""Approximate number of pixels of a map without a given GSD; on a wall of 70 x 45 m they measure 18 cm."""
_MOST_PIXELS = 2e7
"""Most pixels of a map."""
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Places:
    """n places on a surface, wall frame: points (n, 3), m; outward unit normals (n, 3); albedo (n,)."""

    points: FloatArray
    normals: FloatArray
    albedo: FloatArray

    def at(self, chosen: BoolArray) -> Places:
        """Return some of the places, selected by a mask (n,)."""
        return Places(self.points[chosen], self.normals[chosen], self.albedo[chosen])


@dataclass(frozen=True)
class WallRaster:
    """The wall seen along -z.

    Attributes
    ----------
    grid : Grid
        Its pixels.
    found : (height, width) bool array
        Where there is a surface.
    places : Places
        The places of those n pixels, row by row.
    """

    grid: Grid
    found: BoolArray
    places: Places

    def image(self, values: NDArray[np.generic]) -> FloatArray:
        """Return n values at their pixels, (height, width), NaN where there is no surface."""
        result = np.full(self.grid.shape, np.nan)
        result[self.found] = values
        return result


def wall_raster(caster: RayCaster, gsd_m: float | None = None) -> WallRaster:
    """Sample a wall (wall frame) at the pixels of a grid; without `gsd_m` it has about 100,000 pixels.

    Raises InputError if the GSD is larger than the wall, or so small that the maps would have more than 20 million pixels.
    """
    bounds = caster.mesh.bounds
    extent = bounds[1, :2] - bounds[0, :2]
    gsd = gsd_m or float(np.sqrt(extent.prod() / _PIXELS))
    finest, coarsest = float(np.sqrt(extent.prod() / _MOST_PIXELS)), float(extent.min())
    if not finest <= gsd <= coarsest:
        raise InputError(
            f"a pixel of {gsd:g} m is too large or too small for a wall of {extent[0]:.1f} x {extent[1]:.1f} m",
            where="planning.gsd_m",
            allowed=f"{finest:.2g} to {coarsest:.3g} m",
        )
    grid = Grid.over(bounds, gsd)
    hits, point = caster.look_down(grid)
    valid, normal, albedo = hits.valid, hits.normal, hits.albedo
    dr.eval(valid, point, normal, albedo)
    found = np.array(valid)
    if not found.any():
        raise InputError(
            "no part of the wall is visible along the normal of its mean plane", where="wall", remedy="check the mesh"
        )
    points, normals = (np.array(array, dtype=np.float64).T[found] for array in (point, normal))
    places = Places(points, normals, np.array(albedo, dtype=np.float64)[found])
    return WallRaster(grid, found.reshape(grid.shape), places)


def visible_from(caster: RayCaster, places: Places, viewpoint: FloatArray) -> BoolArray:
    """Return whether each place (n,) faces `viewpoint` (3,), m, with nothing in between."""
    facing = np.einsum("ni,ni->n", places.normals, places.points - viewpoint) < 0
    origin = vector(viewpoint)
    sight = vectors_on_device(places.points) - origin
    hidden = caster.occluded(origin, sight, dr.opaque(mi.Float64, 1.0 - SHADOW_MARGIN), coherent=False)
    return facing & ~np.array(hidden)


def rotate_vectors(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    """Multiply a matrix (3, 3) with each of the vectors (n, 3)."""
    return np.einsum("ij,nj->ni", matrix, vectors)


def surface_shift(ray: FloatArray, turn: FloatArray, normals: FloatArray) -> FloatArray:
    """Return how far (n, 3) the point where a ray hits a tangent plane moves when the ray changes.

    With the ray c + t r and the plane's normal n: dp = t (dr - r (n . dr) / (n . r)).

    Parameters
    ----------
    ray : (n, 3) array
        t r, from the centre to the surface, m.
    turn : (n, 3) array
        t dr, m.
    normals : (n, 3) array
        Unit normals.
    """
    along = np.einsum("ni,ni->n", normals, turn) / np.einsum("ni,ni->n", normals, ray)
    return turn - ray * along[:, None]
