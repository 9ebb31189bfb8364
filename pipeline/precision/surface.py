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
    """Hold n places on a wall, for which the precision of a sensor is predicted.

    Attributes
    ----------
    points : (n, 3) array
        Positions, wall frame, m.
    normals : (n, 3) array
        Outward unit normals of the surface, wall frame.
    albedo : (n,) array
        Share of light that the rock reflects, 0 to 1.
    """

    points: FloatArray
    normals: FloatArray
    albedo: FloatArray

    def at(self, chosen: BoolArray) -> Places:
        """Return the chosen ones of the n places. chosen: mask (n,), true for places to keep."""
        return Places(self.points[chosen], self.normals[chosen], self.albedo[chosen])


@dataclass(frozen=True)
class WallRaster:
    """Hold a wall sampled on a raster of pixels in its front view, for maps of predicted quantities.

    The lines of sight run along -z of the wall frame.

    Attributes
    ----------
    grid : Grid
        Size and position of the pixels.
    found : (height, width) bool array
        True where the line of sight meets the surface.
    places : Places
        The n places on the surface at those pixels, row by row.
    """

    grid: Grid
    found: BoolArray
    places: Places

    def image(self, values: NDArray[np.generic]) -> FloatArray:
        """Arrange predicted values at the n places as an image of the wall.

        values: (n,) one for each pixel with a surface, row by row. Returns (height, width) values, NaN elsewhere.
        """
        result = np.full(self.grid.shape, np.nan)
        result[self.found] = values
        return result


def wall_raster(caster: RayCaster, gsd_m: float | None = None) -> WallRaster:
    """Sample a wall on a raster of pixels in its front view, for maps of predicted quantities.

    The lines of sight run along -z of the wall frame.

    Parameters
    ----------
    caster : RayCaster
        Casts rays on the wall's mesh, wall frame.
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
    """Test whether each place on a wall faces a viewpoint with no rock in between.

    Parameters
    ----------
    caster : RayCaster
        Casts rays on the wall's mesh, wall frame.
    places : Places
        The n places, with positions and normals.
    viewpoint : (3,) array
        Position of the camera or scanner, wall frame, m.

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
    """Multiply each of n vectors by a matrix, for example to rotate them into another frame.

    matrix: (3, 3). vectors: (n, 3). Returns (n, 3).
    """
    return np.einsum("ij,nj->ni", matrix, vectors)


def surface_shift(ray: FloatArray, turn: FloatArray, normals: FloatArray) -> FloatArray:
    """Compute how far the point where a ray hits a plane moves if the ray's direction changes a little, for error propagation.

    The ray hits at c + t r, with origin c, direction r and length t. n is the plane's normal. If r changes by dr, the point
    moves by dp = t (dr - r (n . dr) / (n . r)).

    Parameters
    ----------
    ray : (n, 3) array
        t r: vectors from the origin of each ray to its plane, m.
    turn : (n, 3) array
        t dr: changes of the direction times t, m.
    normals : (n, 3) array
        Unit normals of the planes.

    Returns
    -------
    (n, 3) array
        Shifts dp, m.
    """
    along = np.einsum("ni,ni->n", normals, turn) / np.einsum("ni,ni->n", normals, ray)
    return turn - ray * along[:, None]
