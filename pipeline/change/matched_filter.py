"""Compute how well a niche stands out from a map's noise: the signal-to-noise ratio of a filter matched to its shape.

The filter correlates the map with the true change t(p). In stationary noise with covariance C and power spectrum
S(k) = <|N(k)|^2>, the mean of its output is sum t^2 and its variance t' C t, so

    rho = sum_k |T(k)|^2 / sqrt(sum_k |T(k)|^2 S(k)),    in white noise of standard deviation s:  rho^2 = sum_p t(p)^2 / s^2

which is the best linear test in white noise (Turin 1960, "An introduction to matched filters"). Whitening would increase the
ratio only formally: it would use sharp rims at frequencies where a map interpolated from coarse samples contains neither noise
nor niche. S is estimated outside the blocks (Welch 1967: overlapping windows with a Hann taper).

Where samples are coarse, the map shows less of a niche than the true change. Where a surface has finer triangles inside niches
than outside, the noise in them has a finer grain. As the truth is known, both can be measured in the filter's output, and the
ratios of a map are corrected for them (`_correction`). Limits: a detector does not know position and shape, so it finds fewer
blocks.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, FloatArray, IntArray
from scene.ray_casting.raycast import RayCaster

_SIDES = (64, 128, 256)
"""Sides of the windows on which spectra are estimated, px."""
_LEAST_BLOCKS = 20
"""Fewest blocks from which a correction is estimated."""
_LEAST_FREE = 0.5
"""Smallest share of a window outside of blocks and with data for which the window is used."""


def signal_to_noise(
    difference: NDArray[np.float32], block: IntArray, change: NDArray[np.float32], count: int
) -> NDArray[np.float64]:
    """Compute how well each niche stands out from the noise of a difference map, to know which blocks a detector could find.

    The measure is the signal-to-noise ratio of a filter that is matched to the niche's true shape.

    Parameters
    ----------
    difference : (h, w) array
        Difference map, m; NaN without data.
    block : (h, w) array
        Labels of the fallen blocks, from 1; 0 outside.
    change : (h, w) array
        True loss of the wall at each pixel, m.
    count : int
        Number of blocks.

    Returns
    -------
    (count,) array
        The ratio of each block, by its label: NaN if it cannot be determined, 0 for a block that is not in the map.
    """
    from scipy import ndimage

    noise = np.where((block == WALL) & np.isfinite(difference), difference, np.float32(np.nan))
    spectra = _Spectra(noise)
    seen = np.where(np.isfinite(difference) & np.isfinite(change), change, np.float32(0.0))
    result, share = np.zeros(count), np.full(count, np.nan)
    for index, box in enumerate(ndimage.find_objects(block, count)):
        if box is None:
            continue
        template = np.where(block[box] == index + 1, seen[box], 0.0)
        spectrum = spectra.of(2 * max(template.shape))
        result[index] = np.nan if spectrum is None else _ratio(template, spectrum)
        if template.any():
            share[index] = np.sum(template * np.where(template != 0, difference[box], 0.0)) / np.sum(template**2)
    return result * _correction(share, result)


def _correction(share: NDArray[np.float64], ratio: NDArray[np.float64]) -> float:
    """Return the factor by which the ratios of one map are multiplied.

    It is estimated from the share a = sum t d / sum t^2 of each change that the filter finds. The median of a tells how much
    of a change the map shows. The robust standard deviation of (a - median) rho is 1 if the spectrum is right; it tells how
    the noise inside niches differs from that outside. With few blocks the factor is 1.
    """
    known = np.isfinite(share) & np.isfinite(ratio) & (ratio > 0)
    if known.sum() < _LEAST_BLOCKS:
        return 1.0
    middle = float(np.median(share[known]))
    scatter = 1.4826 * float(np.median(np.abs(share[known] - middle) * ratio[known]))
    return max(middle, 0.0) / scatter if scatter > 0 else 1.0


class _Spectra:
    """The noise's spectra on windows of several sizes, each estimated when it is first needed."""

    def __init__(self, noise: NDArray[np.float32]) -> None:
        self._noise = noise
        self._known: dict[int, FloatArray | None] = {}

    def of(self, least: int) -> FloatArray | None:
        """Return the spectrum of the smallest windows of at least `least` px, else of the largest that there are."""
        enough = next((number for number, side in enumerate(_SIDES) if side >= least), len(_SIDES) - 1)
        for side in (*_SIDES[enough:], *reversed(_SIDES[:enough])):
            if side not in self._known:
                self._known[side] = noise_spectrum(self._noise, side)
            if self._known[side] is not None:
                return self._known[side]
        return None


def noise_spectrum(noise: NDArray[np.float32], side: int) -> FloatArray | None:
    """Estimate the power spectrum of a map's noise by Welch's method of overlapping windows, to judge what stands out from it.

    noise: (h, w) values of the map outside of blocks, m; NaN elsewhere. side: side of a window, px. Returns the mean
    |N(k)|^2 of the windows' discrete Fourier transforms N, (side, side), m2; None if no window has enough data.
    """
    from scipy import ndimage

    taper, middle = _taper(side), np.nanmedian(noise) if np.isfinite(noise).any() else 0.0
    total, weight = np.zeros((side, side)), 0.0
    for window in _windows(noise, side):
        free = np.isfinite(window)
        if free.mean() < _LEAST_FREE:
            continue
        total += np.abs(np.fft.fft2(np.where(free, window - middle, 0.0) * taper)) ** 2
        weight += float(np.sum(taper**2 * free))
    if weight == 0 or not total.any():
        return None
    spectrum = ndimage.uniform_filter(total * side**2 / weight, 3, mode="wrap")  # smooth over neighbours, as few windows scatter
    return np.asarray(spectrum)


def true_change(
    wall: RayCaster, carved: RayCaster, block: IntArray, grid: Grid, shift_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return how much rock the wall truly lost at the pixels of the niches, along z, to compare a difference map with it.

    Parameters
    ----------
    wall, carved : RayCaster
        The wall before and after the blocks fell, wall frame.
    block : (h, w) array
        Labels of the fallen blocks in the map, 0 outside.
    grid : Grid
        The map's pixels.
    shift_m : (h, w, 2) array
        By how much the map is displaced from the true wall in x and y at each pixel, m.

    Returns
    -------
    (h, w) float32 array
        The loss, m; 0 outside niches, NaN where there is no wall.
    """
    row, column = np.nonzero(block != WALL)
    result = np.zeros(grid.shape, dtype=np.float32)
    if len(row) == 0:
        return result
    place = np.stack([grid.x_min + (column + 0.5) * grid.gsd, grid.y_max - (row + 0.5) * grid.gsd], axis=1) - shift_m[row, column]
    start = np.column_stack([place, np.full(len(place), max(each.mesh.bounds[1, 2] for each in (wall, carved)) + 1.0)])
    down = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
    result[row, column] = carved.cast(start, down)[0] - wall.cast(start, down)[0]
    return result


def _ratio(template: FloatArray, spectrum: FloatArray) -> float:
    """Return rho of a template.

    A template larger than the spectrum's window is averaged to coarser pixels, whose noise counts as white.
    """
    side = len(spectrum)
    step = -(-max(template.shape) // side)
    if step > 1:
        template = np.pad(template, [(0, -length % step) for length in template.shape])
        rows, columns = (length // step for length in template.shape)
        template = template.reshape(rows, step, columns, step).mean(axis=(1, 3))
    power = np.abs(np.fft.fft2(template, (side, side))) ** 2
    return float(np.sum(power) / np.sqrt(np.sum(power * spectrum)) * step) if power.any() else 0.0


def _windows(noise: NDArray[np.float32], side: int) -> Iterator[NDArray[np.float32]]:
    """Yield windows that overlap by half."""
    height, width = noise.shape
    for row in range(0, height - side + 1, side // 2):
        for column in range(0, width - side + 1, side // 2):
            yield noise[row : row + side, column : column + side]


@lru_cache
def _taper(side: int) -> FloatArray:
    """Return a Hann taper (side, side)."""
    window = np.hanning(side + 1)[:-1]
    return np.outer(window, window)
