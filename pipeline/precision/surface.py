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
    """n places on a surface, wall frame.

    Attributes
    ----------
    points : (n, 3) array
        Positions, m.
    normals : (n, 3) array
        Outward unit normals.
    albedo : (n,) array
        Albedo.
    """

    points: FloatArray
    normals: FloatArray
    albedo: FloatArray

    def at(self, chosen: BoolArray) -> Places:
        """Return the places that a mask (n,) selects."""
        return Places(self.points[chosen], self.normals[chosen], self.albedo[chosen])


@dataclass(frozen=True)
class WallRaster:
    """A wall sampled on a grid, as seen along -z of the wall frame.

    Attributes
    ----------
    grid : Grid
        The pixels.
    found : (height, width) bool array
        True where there is a surface.
    places : Places
        The n places on the surface at those pixels, row by row.
    """

    grid: Grid
    found: BoolArray
    places: Places

    def image(self, values: NDArray[np.generic]) -> FloatArray:
        """Arrange n values of the places as an image (height, width), with NaN where there is no surface."""
        result = np.full(self.grid.shape, np.nan)
        result[self.found] = values
        return result


def wall_raster(caster: RayCaster, gsd_m: float | None = None) -> WallRaster:
    """Sample a wall at the pixels of a grid, looking along -z of the wall frame.

    Parameters
    ----------
    caster : RayCaster
        The wall, wall frame.
    gsd_m : float, optional
        Side of a pixel, m; by default chosen for about 100,000 pixels.

    Raises
    ------
    InputError
        If the pixels are larger than the wall or more than 20 million, or if no surface is found.
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
            remedy="choose a pixel size in this range",
        )
    grid = Grid.over(bounds, gsd)
    hits, point = caster.look_down(grid)
    valid, normal, albedo = hits.valid, hits.normal, hits.albedo
    dr.eval(valid, point, normal, albedo)
    found = np.array(valid)
    if not found.any():
        raise InputError(
            "no part of the wall is visible along the normal of its mean plane",
            where="wall",
            remedy="give a mesh that is one surface, with triangles that face the sensor",
        )
    points, normals = (np.array(array, dtype=np.float64).T[found] for array in (point, normal))
    places = Places(points, normals, np.array(albedo, dtype=np.float64)[found])
    return WallRaster(grid, found.reshape(grid.shape), places)


def visible_from(caster: RayCaster, places: Places, viewpoint: FloatArray) -> BoolArray:
    """Return whether each place faces a viewpoint with nothing in between.

    Parameters
    ----------
    caster : RayCaster
        The surface, for tests of visibility.
    places : Places
        n places on it.
    viewpoint : (3,) array
        The viewpoint, wall frame, m.

    Returns
    -------
    (n,) bool array
        True for visible places.
    """
    facing = np.einsum("ni,ni->n", places.normals, places.points - viewpoint) < 0
    origin = vector(viewpoint)
    sight = vectors_on_device(places.points) - origin
    hidden = caster.occluded(origin, sight, dr.opaque(mi.Float64, 1.0 - SHADOW_MARGIN), coherent=False)
    return facing & ~np.array(hidden)


def rotate_vectors(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    """Multiply each of the vectors (n, 3) by a matrix (3, 3)."""
    return np.einsum("ij,nj->ni", matrix, vectors)


def surface_shift(ray: FloatArray, turn: FloatArray, normals: FloatArray) -> FloatArray:
    """Return how far the point where a ray hits a plane moves when the direction of the ray changes a little.

    With the ray c + t r and the plane's normal n: dp = t (dr - r (n . dr) / (n . r)).

    Parameters
    ----------
    ray : (n, 3) array
        t r, from the origin c of the ray to the plane, m.
    turn : (n, 3) array
        t dr, the change of the direction times t, m.
    normals : (n, 3) array
        Unit normals n of the planes.

    Returns
    -------
    (n, 3) array
        Shifts dp, m.
    """
    along = np.einsum("ni,ni->n", normals, turn) / np.einsum("ni,ni->n", normals, ray)
    return turn - ray * along[:, None]
