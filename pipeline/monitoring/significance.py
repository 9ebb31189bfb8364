"""Estimate how large differences are by noise: a level of detection for each pixel, and the error of means over regions.

The variance that a pixel's difference should have is that of the two heights and of the registration. How the differences on
stable rock really scatter is set against it: the level of detection is the 95 % quantile of |difference| / predicted standard
deviation on stable rock, in classes of the predicted one, times that prediction. So rough and smooth rock have levels of their
own, and 5 % of the stable pixels exceed theirs.

Neighbouring pixels share points and registration, so the error of a mean does not fall with the root of the number of pixels.
It is measured on stable rock, as the scatter of means over squares of growing size (Hugonnet et al. 2022, "Uncertainty analysis
of digital elevation models by spatial inference from stable terrain").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pipeline.monitoring.raster_statistics import quantiles
from scene.geometry.mesh import FloatArray

NORMAL_95 = 1.959964
"""The 95 % quantile of the absolute value of a normal variable."""
MEDIAN = 0.674490
"""The median of the absolute value of a normal variable."""
_LONGEST_TAIL = 1.6
"""Times a normal distribution of the same median that a quantile of the noise may reach: what is farther out may have moved."""
_LEAST_FACTOR = 0.1
"""Least level of detection over the predicted standard deviation: copies of one scan do not differ at all."""
_CLASSES = 8
_FEWEST_IN_CLASS = 400
_SIDES = (1, 2, 3, 5, 7, 11, 15, 23, 31, 47, 63)
"""Sides of the squares, pixels, over which means are taken."""
_FEWEST_SQUARES = 12
_QUANTILES = (0.5, 0.9, 0.99, 0.999)
_FILLED = 0.5
"""Share of a square that needs data."""


@dataclass(frozen=True)
class Significance:
    """Size of the height differences that noise alone causes in a difference map.

    Attributes
    ----------
    level : (h, w) float32, m
        Level of detection of each pixel: noise alone exceeds it in 5 % of cases; NaN without data.
    side_px, sigma : (k,) arrays
        Sides of squares, px, and the standard deviation of means over such squares of stable rock. It has no unit, because
        each difference is first divided by the standard deviation of its pixel.
    """

    level: NDArray[np.float32]
    side_px: FloatArray
    sigma: FloatArray

    @property
    def one_sigma(self) -> NDArray[np.float32]:
        """Standard deviation of each pixel's height difference, (h, w), m; NaN without data."""
        return np.asarray(self.level / np.float32(NORMAL_95))

    def sigma_of_mean(self, pixels: float | NDArray[np.floating]) -> FloatArray:
        """Return the standard deviation of a mean over neighbouring pixels, whose errors are correlated.

        The mean is of differences that are each divided by the standard deviation of their pixel, so it has no unit.

        pixels: numbers of pixels, in a roughly square area. For more than in the largest square that was measured on stable
        rock, the result is that of this square.
        """
        side = np.sqrt(np.maximum(pixels, 1.0))
        return np.asarray(np.exp(np.interp(np.log(side), np.log(self.side_px), np.log(self.sigma))))


def significance(difference: NDArray[np.float32], predicted: NDArray[np.float32], stable: NDArray[np.bool_]) -> Significance:
    """Estimate levels of detection and the errors of means from how much the differences on stable rock really scatter.

    Parameters
    ----------
    difference, predicted : (h, w) float32, m
        Height of the reference minus that of the epoch, and the standard deviation that error propagation predicts for it;
        NaN without data.
    stable : (h, w) bool
        Pixels of stable rock.

    Returns
    -------
    Significance
        Level of detection of each pixel, and standard deviations of means.
    """
    level = predicted * _factor(difference, predicted, stable)
    standard = np.where(stable, difference / (level / NORMAL_95), np.nan)
    known = np.isfinite(standard)
    filled = np.where(known, standard, 0.0)
    sides: list[float] = []
    sigmas: list[float] = []
    for side in _SIDES:
        means = _means_of_squares(filled, known, side)
        if len(means) < _FEWEST_SQUARES and sides:
            break
        sides.append(float(side))
        sigmas.append(_sigma_with_tails(means))
    return Significance(level.astype(np.float32), np.array(sides), np.minimum.accumulate(np.array(sigmas)))


def _sigma_with_tails(means: NDArray[np.float64]) -> float:
    """Largest of the standard deviations that quantiles tell, from the median on outwards: noise has long tails at edges."""
    apart = np.abs(means - quantiles(means, [0.5]))
    known = [quantile for quantile in _QUANTILES if (1 - quantile) * len(apart) >= 1]
    found = quantiles(apart, known) / ndtri((1 + np.array(known)) / 2)
    return float(max(min(found.max(), _LONGEST_TAIL * found[0]), 1e-3))


def _factor(difference: NDArray[np.float32], predicted: NDArray[np.float32], stable: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(h, w) by how much the level of detection exceeds the predicted standard deviation."""
    of = predicted[stable]
    order = np.argsort(of)
    of, ratio = of[order], (np.abs(difference[stable]) / of)[order]
    classes = int(np.clip(len(ratio) // _FEWEST_IN_CLASS, 1, _CLASSES))
    edges = quantiles(of, np.linspace(0, 1, classes + 1), ordered=True)
    begins, ends = np.searchsorted(of, edges[:-1], "left"), np.searchsorted(of, edges[1:], "right")
    middle, quantile = [], []
    for begin, end in zip(begins, ends, strict=True):
        if end > begin:
            middle.append(float(quantiles(of[begin:end], [0.5], ordered=True)[0]))
            half, most = quantiles(ratio[begin:end], [0.5, 0.95])
            quantile.append(float(max(min(most, _LONGEST_TAIL * NORMAL_95 * half / MEDIAN), _LEAST_FACTOR)))
    return np.interp(predicted, middle, quantile).astype(np.float32)


def _means_of_squares(filled: NDArray[np.floating], known: NDArray[np.bool_], side: int) -> NDArray[np.float64]:
    """Means over the squares of a grid that have data in most of their pixels. filled: values, zero where they are not known."""
    if side == 1:
        return filled[known].astype(np.float64)
    height, width = (size // side * side for size in filled.shape)
    if not height or not width:
        return np.empty(0)
    count = _sums_of_squares(known[:height, :width].view(np.uint8), side)
    total = _sums_of_squares(filled[:height, :width], side) / np.maximum(count, 1)
    return np.asarray(total[count >= _FILLED * side**2], dtype=np.float64)


def _sums_of_squares(raster: NDArray[Any], side: int) -> NDArray[Any]:
    """Sums over the squares into which a raster is divided; first over rows and then over columns, which is fastest."""
    rows = raster.reshape(-1, side, raster.shape[1]).sum(axis=1, dtype=np.result_type(raster, np.int16))
    return np.asarray(rows.reshape(len(rows), -1, side).sum(axis=2))
