"""How well a niche stands out from a map's noise: the signal-to-noise ratio of a filter matched to its shape.

The filter correlates the map with the change t(p) that really happened. In stationary noise n with the power spectrum
S(k) = <|N(k)|^2> its output is sum t^2 in the mean and scatters by the root of t' C t, so

    rho = sum_k |T(k)|^2 / sqrt(sum_k |T(k)|^2 S(k)),    in white noise of standard deviation s:  rho^2 = sum_p t(p)^2 / s^2

which is the best linear test in white noise (Turin 1960, "An introduction to matched filters"). Whitening would gain more on
paper: it would look for sharp rims at frequencies where a map interpolated from coarse samples has no noise, but no niche
either. S is estimated outside of the blocks (Welch 1967: overlapping windows under a Hann taper).
Where samples are coarse the map shows less of a niche than really happened, and where a surface has finer triangles inside
niches than outside, the noise in them has a finer grain. As the truth is known, both are seen in what the filter finds, and the
ratios of a map are corrected for them (`_correction`). Limits: a detector does not know place and shape, so it finds fewer.
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
_LEAST_BLOCKS = 20
_LEAST_FREE = 0.5
"""Share of a window outside of blocks and with data from which it counts."""


def signal_to_noise(
    difference: NDArray[np.float32], block: IntArray, change: NDArray[np.float32], count: int
) -> NDArray[np.float64]:
    """(count,) rho of each block in a difference map (h, w), m; NaN where it cannot be told, 0 of a block that does not show.

    block: (h, w) labels; change: (h, w) what the wall really lost at each pixel, m.
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
    """By what the ratios of one map are to be multiplied, from what the filter found of each change: share a = sum t d / sum t^2.

    The median of a tells how much of a change the map shows, the scatter of (a - median) rho, 1 where the spectrum is right, how
    noise inside niches differs from that outside. 1 where few blocks tell.
    """
    known = np.isfinite(share) & np.isfinite(ratio) & (ratio > 0)
    if known.sum() < _LEAST_BLOCKS:
        return 1.0
    middle = float(np.median(share[known]))
    scatter = 1.4826 * float(np.median(np.abs(share[known] - middle) * ratio[known]))
    return max(middle, 0.0) / scatter if scatter > 0 else 1.0


class _Spectra:
    """The noise's spectra on windows of some sides, each made when it is first asked for."""

    def __init__(self, noise: NDArray[np.float32]) -> None:
        self._noise = noise
        self._known: dict[int, FloatArray | None] = {}

    def of(self, least: int) -> FloatArray | None:
        """The spectrum of the smallest windows of `least` px or more, else of the largest that there is."""
        enough = next((number for number, side in enumerate(_SIDES) if side >= least), len(_SIDES) - 1)
        for side in (*_SIDES[enough:], *reversed(_SIDES[:enough])):
            if side not in self._known:
                self._known[side] = noise_spectrum(self._noise, side)
            if self._known[side] is not None:
                return self._known[side]
        return None


def noise_spectrum(noise: NDArray[np.float32], side: int) -> FloatArray | None:
    """(side, side) mean |N(k)|^2, m2, of windows of `side` px of a map (h, w) of noise, NaN where it is not; None without any."""
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
    spectrum = ndimage.uniform_filter(total * side**2 / weight, 3, mode="wrap")  # few windows scatter: neighbours are alike
    return np.asarray(spectrum)


def true_change(
    wall: RayCaster, carved: RayCaster, block: IntArray, grid: Grid, shift_m: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(h, w) what the wall really lost at the pixels with a label, m, 0 elsewhere, NaN where there is no wall.

    wall, carved: before and after; shift_m: (h, w, 2) by which the map is displaced, in x and y.
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
    """rho of a template; one that is larger than the spectrum's window is seen in coarser pixels, their noise taken as white."""
    side = len(spectrum)
    step = -(-max(template.shape) // side)
    if step > 1:
        template = np.pad(template, [(0, -length % step) for length in template.shape])
        rows, columns = (length // step for length in template.shape)
        template = template.reshape(rows, step, columns, step).mean(axis=(1, 3))
    power = np.abs(np.fft.fft2(template, (side, side))) ** 2
    return float(np.sum(power) / np.sqrt(np.sum(power * spectrum)) * step) if power.any() else 0.0


def _windows(noise: NDArray[np.float32], side: int) -> Iterator[NDArray[np.float32]]:
    height, width = noise.shape
    for row in range(0, height - side + 1, side // 2):
        for column in range(0, width - side + 1, side // 2):
            yield noise[row : row + side, column : column + side]


@lru_cache
def _taper(side: int) -> FloatArray:
    window = np.hanning(side + 1)[:-1]
    return np.outer(window, window)
