"""Refine disparities by least-squares matching, which removes the pixel locking that semi-global matching leaves."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from scene.common.backend import dr, mi
from scene.common.config import Config
from scene.ray_casting.upload import on_device
from sensors.numerics.device import bounded
from sensors.stereo.rectified import Disparity, Picture

PREFILTER_PX = 0.7
"""Standard deviation of the Gaussian with which both pictures are filtered first. Texture too fine for interpolation would bias
the match towards whole pixels (Pan 2013, Optics and Lasers in Engineering 51).
"""
SLOPE_SCALE_PX = 4.0
"""Standard deviation of the Gaussian window from which the disparity's slope is taken."""
STEEPEST = 1.0
"""Largest slope of the disparity, px/px, that a window follows."""
EDGE_PX = 0.75
"""Scatter of the disparities about the local plane beyond which a window contains a depth step and is not tilted."""
OWN_SURFACE_PX = 1.0
"""Largest difference between the matcher's disparity at a pixel and the window's plane. Pixels beyond a depth step are so
excluded, because the other surface would bias the match.
"""
LEAST_SHARE = 0.4
"""Smallest share of a window's pixels that must be used."""
MATCHER_SIGMA_PX = 0.2
"""Standard deviation of the matcher's own disparity, for its weight relative to the window's."""
LARGEST_STEP_PX = 0.5
"""Largest change of the disparity in one iteration."""
LARGEST_SHIFT_PX = 1.5
"""A match that moves farther than this from the matcher's disparity is dropped as wrong."""


class RefinementConfig(Config):
    """Settings of least-squares matching, which improves the disparities that semi-global matching has found.

    Each disparity is fitted anew, with a small window of the right picture against that of the left one. One pixel (px) is one of
    the pictures that are matched, that is a cell of the depth map.
    """

    steps: int = Field(3, ge=1, le=50, description="iterations")
    window_px: int = Field(5, ge=3, le=31, description="side of the window, odd [px]")
    largest_sigma_px: float = Field(0.5, gt=0, description="matches with a larger standard deviation are dropped [px]")
    least_correlation: float = Field(0.7, ge=0, lt=1, description="matches whose windows correlate less are dropped")

    @field_validator("window_px")
    @classmethod
    def _odd(cls, size: int) -> int:
        if size % 2 == 0:
            raise ValueError("must be odd")
        return size


def refine(left: Picture, right: Picture, disparity: Disparity, config: RefinementConfig) -> Disparity:
    """Refine disparities by least-squares matching of windows along the row.

    Over the pixels x of a window that show the same surface, L(x) = a R(x - d - s . dx) + b is solved for contrast a,
    brightness b and disparity d by Gauss-Newton steps (Lucas & Kanade 1981; Gruen 1985). L and R are the left and the right
    picture, and dx is the distance from the window's centre. s is the local slope of the disparity, so that windows follow
    slanted rock. R is interpolated by cubic convolution (Keys 1981). The standard deviation s_d of d follows from the
    residuals. The result is the weighted mean (d / s_d^2 + d_0 / s_0^2) / (1 / s_d^2 + 1 / s_0^2) with the matcher's d_0 and
    its s_0, so that a window without texture leaves d_0 unchanged. Matches are dropped if they end less certain or less similar
    than the config requires, or more than 1.5 cells from where they started.

    Parameters
    ----------
    left, right : (h, any) arrays
        Grey values, NaN outside the images.
    disparity : (h, w) array
        The matcher's disparities, cells; NaN without a match.
    config : RefinementConfig
        Window and thresholds.

    Returns
    -------
    (h, w) array
        Refined disparities, NaN without a match.
    """
    cell = np.flatnonzero(~np.isnan(disparity))
    slopes = [on_device(mi.Float32, slope.ravel()[cell]) for slope in _slopes(disparity)]
    start = on_device(mi.Float32, disparity.ravel()[cell])
    smooth_left, smooth_right = (cv2.GaussianBlur(picture, (0, 0), PREFILTER_PX) for picture in (left, right))
    pictures, found = _Pictures.on_device(smooth_left, smooth_right, disparity), mi.Float32(start)
    row, column = (on_device(mi.Int32, place) for place in np.divmod(cell, left.shape[1]))
    sigma, correlation = (dr.opaque(mi.Float32, value) for value in (config.largest_sigma_px, config.least_correlation))
    for _ in range(config.steps):
        fit = pictures.fit(row, column, found, start, slopes, config.window_px // 2)
        found += bounded(fit.step, -LARGEST_STEP_PX, LARGEST_STEP_PX)
        kept = (fit.sigma <= sigma) & (fit.correlation >= correlation) & (dr.abs(found - start) <= LARGEST_SHIFT_PX)
        weighted = start + (found - start) / (1 + dr.square(fit.sigma / MATCHER_SIGMA_PX))
        dr.eval(found, weighted, kept)
    result = np.full(disparity.size, np.nan, dtype=np.float32)
    result[cell] = np.where(kept.numpy(), weighted.numpy(), np.nan)
    return result.reshape(disparity.shape)


@dataclass(frozen=True)
class _Fit:
    """Result of one Gauss-Newton step, (n,) each.

    Attributes
    ----------
    step : mi.Float32
        Change of the disparity, px.
    sigma : mi.Float32
        Standard deviation of the disparity, px; infinite if the fit fails.
    correlation : mi.Float32
        Coefficient of correlation of the two windows.
    """

    step: mi.Float32
    sigma: mi.Float32
    correlation: mi.Float32


@dataclass(frozen=True)
class _Pictures:
    """Both pictures and the matcher's disparities on the device, row by row, with their common height and their widths."""

    left: mi.Float32
    right: mi.Float32
    disparity: mi.Float32
    height: mi.Int32
    left_width: mi.Int32
    right_width: mi.Int32

    @classmethod
    def on_device(cls, left: Picture, right: Picture, disparity: Disparity) -> _Pictures:
        """Copy pictures and disparities to the device."""
        sizes = (dr.opaque(mi.Int32, size) for size in (left.shape[0], left.shape[1], right.shape[1]))
        return cls(*(on_device(mi.Float32, raster) for raster in (left, right, disparity)), *sizes)

    def fit(
        self, row: mi.Int32, column: mi.Int32, disparity: mi.Float32, start: mi.Float32, slopes: list[mi.Float32], half: int
    ) -> _Fit:
        """Take one Gauss-Newton step at each of n cells.

        Parameters
        ----------
        row, column : mi.Int32, (n,)
            The cells.
        disparity : mi.Float32, (n,)
            Present disparities.
        start : mi.Float32, (n,)
            The matcher's disparities, which tell the window's surface from others.
        slopes : list of two mi.Float32, (n,)
            Slopes of the disparity along row and column.
        half : int
            Half the side of the window, rounded down.
        """
        side = 2 * half + 1
        reference = dr.gather(mi.Float32, self.left, row * self.left_width + column)  # keeps the sums small

        def add(tap: mi.Int32, sums: tuple[mi.Float32, ...], inside: mi.Bool) -> tuple[mi.Int32, tuple[mi.Float32, ...], mi.Bool]:
            dx, dy = tap % side - half, tap // side - half
            x, y = column + dx, row + dy
            change = slopes[0] * mi.Float32(dx) + slopes[1] * mi.Float32(dy)
            target = mi.Float32(x) - disparity - change
            base = dr.floor(target)
            first, y_safe, x_safe = mi.Int32(base) - 1, bounded(y, 0, self.height - 1), bounded(x, 0, self.left_width - 1)
            within = (x == x_safe) & (y == y_safe) & (base >= 1) & (base + 2 < self.right_width)  # NaN is outside
            cell = y_safe * self.left_width + x_safe
            counts = dr.abs(dr.gather(mi.Float32, self.disparity, cell) - start - change) <= OWN_SURFACE_PX
            value, gradient = self._cubic(y_safe * self.right_width + first, target - base, within & counts)
            grey = dr.gather(mi.Float32, self.left, cell) - reference
            value -= reference
            terms = (mi.Float32(1), grey, value, gradient, grey * grey, value * value, gradient * gradient)
            mixed = (grey * value, grey * gradient, value * gradient)
            added = tuple(total + dr.select(counts, term, 0) for total, term in zip(sums, terms + mixed, strict=True))
            return tap + 1, added, inside & (within | ~counts)

        zeros = tuple(dr.zeros(mi.Float32, dr.width(row)) for _ in range(10))
        state = (mi.Int32(0), zeros, dr.full(mi.Bool, True, dr.width(row)))
        _, sums, inside = dr.while_loop(state, lambda tap, *_: tap < side * side, add, labels=("tap", "sums", "inside"))
        return _solution(sums, inside & (sums[0] >= LEAST_SHARE * side * side))

    def _cubic(self, first: mi.Int32, t: mi.Float32, active: mi.Bool) -> tuple[mi.Float32, mi.Float32]:
        """Interpolate the right picture between four cells by a cubic (Keys, a = -1/2); return value and slope.

        The position is at the fraction t after the second of the cells, which start at `first`.
        """
        a, b, c, d = (dr.gather(mi.Float32, self.right, first + k, active) for k in range(4))
        linear, square, cube = (c - a) / 2, a - 2.5 * b + 2 * c - 0.5 * d, (d - a) / 2 + 1.5 * (b - c)
        return b + t * (linear + t * (square + t * cube)), linear + t * (2 * square + 3 * t * cube)


def _solution(sums: tuple[mi.Float32, ...], enough: mi.Bool) -> _Fit:
    """Solve the fit from the sums over the window's pixels: 1, L, R, G, LL, RR, GG, LR, LG, RG, where G = dR/dx.

    After subtracting the means, L = a R + c G has the normal equations [RR RG; RG GG] [a c] = [LR LG]; the step is -c / a.
    """
    n = sums[0]
    mean_l, mean_r, mean_g = (total / n for total in sums[1:4])
    ll, rr, gg = (total - n * mean * mean for total, mean in zip(sums[4:7], (mean_l, mean_r, mean_g), strict=True))
    lr, lg, rg = sums[7] - n * mean_l * mean_r, sums[8] - n * mean_l * mean_g, sums[9] - n * mean_r * mean_g
    determinant = rr * gg - rg * rg
    gain, shift = (lr * gg - lg * rg) / determinant, (lg * rr - lr * rg) / determinant
    residual = bounded(ll - gain * lr - shift * lg, 0, ll)
    variance = residual / (n - 3) * rr / determinant / dr.square(gain)
    solved = enough & (determinant > 1e-3 * rr * gg) & (gain > 0.2) & (gain < 5) & (variance < 1e6)
    correlation = dr.sqrt(1 - residual / ll)
    return _Fit(dr.select(solved, -shift / gain, 0), dr.select(solved, dr.sqrt(variance), np.inf), correlation)


def _slopes(disparity: Disparity) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the slopes (h, w) of the disparity along row and column, from Gaussian means over the matched cells."""
    known = ~np.isnan(disparity)
    weight = _blurred(known.astype(np.float32))
    centre = np.float32(np.mean(disparity[known])) if known.any() else np.float32(0)  # keeps the squares small
    local = np.where(known, disparity - centre, np.float32(0))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, square = _blurred(local) / weight, _blurred(local * local) / weight
    slopes = [np.nan_to_num(cv2.Sobel(np.nan_to_num(mean), cv2.CV_32F, *axis, ksize=1) / 2) for axis in ((1, 0), (0, 1))]
    scatter = square - mean * mean - SLOPE_SCALE_PX**2 * (slopes[0] ** 2 + slopes[1] ** 2)
    with np.errstate(invalid="ignore"):
        edge = ~(scatter < EDGE_PX**2)
    flat = [np.where(edge | (np.abs(slope) > STEEPEST), np.float32(0), slope) for slope in slopes]
    return flat[0], flat[1]


def _blurred(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Filter an array with the Gaussian of SLOPE_SCALE_PX."""
    return cv2.GaussianBlur(values, (0, 0), SLOPE_SCALE_PX)
