"""Turn points into a raster of heights with a standard deviation for each pixel, without triangles.

A plane is fitted by least squares to the points in 3 x 3 pixels about each pixel,

    z = h + a u + b v,

u and v the offsets from the pixel's centre in x and y, wall frame, m. The height h at the centre has the variance s^2 q, where s
is the standard deviation of the points about the plane and q the first diagonal element of the inverse normal matrix. Sums over
the points of each pixel are all that is kept, so that memory depends on the raster and not on the number of points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse._sparsetools import csc_matvecs  # np.add.at takes twice the time

from pipeline.monitoring.raster_statistics import quantiles
from pipeline.registration.rigid import RigidTransform
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_FEWEST = 4
"""Points that a plane needs, one more than it has parameters."""
_MOST_LEVERAGE = 1.0
"""Largest q: a pixel whose height is known worse than from a single point at its centre has no data."""
_PRIOR_POINTS = 4.0
"""Weight of the raster's median variance in that of a pixel, in points: few points tell little of their own scatter."""
POINTS_AT_ONCE = 1 << 13
"""Points that are transformed and summed at a time, so that their arrays stay in the processor's cache."""
SAMPLE = 50_000
"""Points of an epoch that ICP works with: it only brings the epoch near, and is followed by a fit of the rasters."""
_BAND = 8
"""Rows to which planes are fitted at a time, so that the sums stay in the processor's cache."""


@dataclass(frozen=True)
class HeightRaster:
    """Heights of one epoch over one view (separately mapped part) of the wall, from planes fitted about each pixel.

    The plane of a pixel is fitted to the points in the 3 x 3 pixels about it.

    Attributes
    ----------
    grid : Grid
        Raster of h x w pixels, frame of the view.
    height, sigma, scatter : (h, w) float32, m
        Height at the pixel's centre, its standard deviation, and the standard deviation of the points about the plane. NaN where
        there are too few points.
    slope_x, slope_y : (h, w) float32
        Slopes of the surface: change of height by x and by y, m/m.
    count : (h, w) int32
        Number of points in the pixel itself.
    """

    grid: Grid
    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    scatter: NDArray[np.float32]
    slope_x: NDArray[np.float32]
    slope_y: NDArray[np.float32]
    count: NDArray[np.int32]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask (h, w) of the pixels that have a height."""
        return np.isfinite(self.height)

    @property
    def steepness(self) -> NDArray[np.float32]:
        """Tangent of the angle between the surface's normal and the raster's z axis, (h, w); NaN without data."""
        return np.asarray(np.hypot(self.slope_x, self.slope_y))


@dataclass(frozen=True)
class WallPoints:
    """Points of an epoch in the wall frame, which are read in chunks if they do not fit into memory.

    Attributes
    ----------
    sample : (n, 3) array
        A subset of the points for ICP, spread over all of the epoch, m.
    moved : callable
        Function of a rigid transform that yields all points, after this transform, in chunks (k, 3), m, each time it is called.
    """

    sample: FloatArray
    moved: Callable[[RigidTransform], Iterable[FloatArray]]

    @classmethod
    def of(cls, points: FloatArray) -> WallPoints:
        """Make the points of an epoch from an array (n, 3), wall frame, m, that is in memory."""
        return cls(points, lambda motion: [motion.apply(points)])


def gridded(points: FloatArray | Iterable[FloatArray], grid: Grid) -> HeightRaster:
    """Return a raster of heights from points: a plane is fitted to the points in the 3 x 3 pixels about each pixel.

    points: (n, 3), frame of the grid, m, or chunks of such arrays. grid: the raster; points outside it are left out.
    """
    sums = PointSums.over(grid)
    for chunk in [points] if isinstance(points, np.ndarray) else points:
        sums.add(chunk)
    return sums.heights()


@dataclass(frozen=True)
class PointSums:
    """Sums over the points of each pixel, from which a plane can be fitted about it; points can be added in chunks.

    Attributes
    ----------
    grid : Grid
        Raster of h x w pixels.
    sums : (h w, 10) array
        For each pixel the sums over its points of 1, u, v, z, uu, uv, vv, uz, vz and zz: u and v are x and y in pixels from the
        pixel's centre, z is the height, m. Those of one pixel lie side by side, because points come in any order.
    """

    grid: Grid
    sums: FloatArray

    @classmethod
    def over(cls, grid: Grid) -> PointSums:
        """Return sums that are still zero for the pixels of a raster, so that points can be added to them. grid: the raster."""
        return cls(grid, np.zeros((grid.height * grid.width, 10)))

    def add(self, points: FloatArray) -> None:
        """Add points (n, 3), frame of the raster, m, to the sums of their pixels; those outside the raster are left out."""
        for start in range(0, len(points), POINTS_AT_ONCE):
            _add_moments(self.sums.reshape(-1), points[start : start + POINTS_AT_ONCE], self.grid)

    def heights(self) -> HeightRaster:
        """Fit planes to all points added so far, and return the raster of heights.

        The height of a pixel is that of a plane at its centre, frame of the raster, m. The plane is fitted to the points in
        the 3 x 3 pixels about it. Heights are NaN where these are fewer than four or do not determine a plane well.
        """
        return _fitted(self.sums.reshape(*self.grid.shape, 10), self.grid)


def _add_moments(sums: FloatArray, points: FloatArray, grid: Grid) -> None:
    """Add to (10 h w,) the sums over points: 1, u, v, z, uu, uv, vv, uz, vz, zz; u and v in pixels from the pixel's centre."""
    x, y, z = np.ascontiguousarray(points.T)
    column, row = (x - grid.x_min) / grid.gsd, (grid.y_max - y) / grid.gsd
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    if not inside.all():
        column, row, z = column[inside], row[inside], z[inside]
    whole_column, whole_row = np.floor(column), np.floor(row)
    pixel = (whole_row * grid.width + whole_column).astype(np.int64)
    u, v = column - whole_column - 0.5, 0.5 - (row - whole_row)
    count = len(pixel)
    moments = np.empty((count, 10))
    moments[:, 0], moments[:, 1], moments[:, 2], moments[:, 3] = 1.0, u, v, z
    for place, (one, other) in enumerate(((u, u), (u, v), (v, v), (u, z), (v, z), (z, z)), start=4):
        np.multiply(one, other, out=moments[:, place])
    # Adds each point's row of moments to that of its pixel: the product of a sparse matrix with `moments`, added to `sums`.
    csc_matvecs(grid.height * grid.width, count, 10, np.arange(count + 1), pixel, np.ones(count), moments.reshape(-1), sums)


def _fitted(sums: FloatArray, grid: Grid) -> HeightRaster:
    """Fit planes to sums (h, w, 10) band by band of rows; the variance that a pixel's is drawn to is the median of its raster."""
    height, scatter, slope_x, slope_y, leverage = np.full((5, *grid.shape), np.nan, dtype=np.float32)
    freedom = np.zeros(grid.shape, dtype=np.float32)
    for start in range(0, grid.height, _BAND):
        stop = min(start + _BAND, grid.height)
        low = max(start - 1, 0)
        rows = sums[low : stop + 1]
        margined = np.zeros((10, stop - start + 2, grid.width + 2))
        margined[:, low - start + 1 : low - start + 1 + len(rows), 1:-1] = rows.transpose(2, 0, 1)
        around = _about_each_pixel(margined)
        band = slice(start, stop)
        freedom[band] = around[0] - 3
        height[band], scatter[band], slope_x[band], slope_y[band], leverage[band] = _planes(around)
    known = np.isfinite(height)
    usual = float(quantiles(scatter[known] / freedom[known], [0.5])[0]) if known.any() else 0.0
    scatter = np.sqrt((scatter + np.float32(_PRIOR_POINTS * usual)) / (freedom + np.float32(_PRIOR_POINTS)))
    slopes = slope_x / np.float32(grid.gsd), slope_y / np.float32(grid.gsd)
    return HeightRaster(grid, height, scatter * np.sqrt(leverage), scatter, *slopes, sums[:, :, 0].astype(np.int32))


def _planes(around: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Height, squared residuals, slopes along u and v, and leverage at the centre of planes; NaN where there is none.

    around: (10, h, w) the sums over the points of each plane.
    """
    n, su, sv, sz, suu, suv, svv, suz, svz, szz = around
    # Cofactors of the symmetric normal matrix [[n, su, sv], [su, suu, suv], [sv, suv, svv]].
    c00, c01, c02 = suu * svv - suv**2, sv * suv - su * svv, su * suv - sv * suu
    c11, c12, c22 = n * svv - sv**2, su * sv - n * suv, n * suu - su**2
    determinant = n * c00 + su * c01 + sv * c02
    with np.errstate(invalid="ignore", divide="ignore"):
        height = (c00 * sz + c01 * suz + c02 * svz) / determinant
        slope_u = (c01 * sz + c11 * suz + c12 * svz) / determinant
        slope_v = (c02 * sz + c12 * suz + c22 * svz) / determinant
        leverage = c00 / determinant
        squares = np.maximum(szz - height * sz - slope_u * suz - slope_v * svz, 0.0)
        known = (n >= _FEWEST) & (determinant > 0) & (leverage <= _MOST_LEVERAGE)
    height, squares, slope_u, slope_v, leverage = (
        np.where(known, each, np.nan) for each in (height, squares, slope_u, slope_v, leverage)
    )
    return height, squares, slope_u, slope_v, leverage


def _about_each_pixel(sums: FloatArray) -> FloatArray:
    """(10, h, w) the sums over 3 x 3 pixels, with u and v from the centre of the middle one; first along rows, then columns.

    sums: (10, h + 2, w + 2) those of each pixel, with a margin of one pixel.
    """
    along = _of_three(sums[:, :, :-2], sums[:, :, 1:-1], sums[:, :, 2:], along_u=True)
    return _of_three(along[:, 2:], along[:, 1:-1], along[:, :-2], along_u=False)


def _of_three(before: FloatArray, middle: FloatArray, after: FloatArray, *, along_u: bool) -> FloatArray:
    """(10, h, w) the sums over three pixels side by side, with offsets from the centre of the middle one.

    The offset u (`along_u`) or v of points in the pixel `before` is one pixel smaller than from that pixel's own centre, and in
    `after` it is one pixel larger.
    """
    own, square, with_z, other = (1, 4, 7, 2) if along_u else (2, 6, 8, 1)
    total = before + after
    total[square] += total[0]
    total += middle
    total[own] += after[0] - before[0]
    total[square] += 2 * (after[own] - before[own])
    total[5] += after[other] - before[other]
    total[with_z] += after[3] - before[3]
    return total
