"""Estimate the spatial correlation of noise: variogram of a difference map, fitted model, number of independent pixels.

The empirical variogram (Matheron 1962) uses every pair of pixels with data,

    gamma(h) = 1 / (2 N(h)) sum (z(x) - z(x + h))^2,

by Fourier transform (Marcotte 1996, "Fast variogram computation with FFT", equation 8), so that no pairs have to be drawn at
random. It is then averaged over directions within bins of |h|. The model is a nugget and up to two nested structures,

    gamma(h) = c_0 + sum c_i s(h / a_i),      s: spherical 1.5 t - 0.5 t^3, exponential 1 - exp(-3 t), gaussian 1 - exp(-3 t^2),

where a is the effective range: s(1) = 1 (spherical) or 0.95. The covariance C(h) = gamma(inf) - gamma(h) gives the standard error
of the mean of n pixels and the effective sample size (Rolstad et al. 2009; Hugonnet et al. 2022, equations 13 to 18),

    Var(mean) = 1/n^2 sum_ij C(h_ij),      n_eff = C(0) / Var(mean),

which are summed exactly over all pairs, also by Fourier transform.

Limits: noise that is correlated beyond the largest lag looks constant and is not in the model, so n_eff is too large. Outliers
dominate squares, so remove them first (`statistics.without_outliers`) and say so.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

Direction = Literal["all", "x", "y"]
Family = Literal["spherical", "exponential", "gaussian"]
_FAMILIES: tuple[Family, ...] = ("spherical", "exponential", "gaussian")
_LAGS = 24
"""Number of bins of distance."""
_SECTOR = np.tan(np.radians(22.5))
"""Directions within 22.5 degrees of an axis count as along it."""
_WORTH = 0.8
"""A further structure is kept if it reduces the squared misfit below this share."""
_MODEL_ERROR = 0.03
"""Relative accuracy to which the model is expected to hold."""
_GOOD_ENOUGH = 0.01
"""Relative misfit below which no further structure is tried."""


@dataclass(frozen=True)
class Variogram:
    """Empirical variogram: how much two pixels of a map differ on average by their distance, because noise is correlated.

    Attributes
    ----------
    lag_m : (k,) array
        Mean distance of the pairs of pixels in each of k bins of distance, m.
    semivariance_m2 : (k,) array
        Half of the mean squared difference of the pairs in each bin, m2.
    pairs : (k,) array
        Number of pairs in each bin.
    """

    lag_m: FloatArray
    semivariance_m2: FloatArray
    pairs: FloatArray

    def to_dict(self) -> dict[str, list[float]]:
        """Return distances (m), semivariances (m2) and numbers of pairs of an empirical variogram as a dictionary for JSON."""
        return {field.name: getattr(self, field.name).tolist() for field in dataclasses.fields(self)}


def variogram(
    values: NDArray[np.floating], gsd_m: float, *, largest_lag_m: float | None = None, direction: Direction = "all"
) -> Variogram:
    """Compute the empirical variogram of one or several rasters, which shows how their noise is correlated over distance.

    All pairs of pixels within a raster are used; pairs across two rasters are not.

    Parameters
    ----------
    values : (h, w) or (e, h, w) array
        One raster or e rasters, m; NaN without data.
    gsd_m : float
        Side of a pixel, m.
    largest_lag_m : float, optional
        Largest distance of a pair, m; by default half of the raster's larger side. Bins of distance grow geometrically from
        one pixel.
    direction : str
        "all", or only pairs whose direction is within 22.5 degrees of "x" (along rows) or "y" (along columns).

    Raises
    ------
    InputError
        If fewer than two pixels have data, or no two of them lie within the largest distance.
    """
    rasters = values[None] if values.ndim == 2 else values
    if np.isfinite(rasters).sum(axis=(1, 2)).max(initial=0) < 2:
        raise InputError(
            "fewer than two pixels have data, so there is no variogram",
            where="variogram",
            remedy="give difference maps in which more pixels have data",
        )
    size = rasters.shape[1:]
    reach = largest_lag_m or gsd_m * max(size) / 2
    steps = tuple(int(min(np.ceil(reach / gsd_m), extent - 1)) for extent in size)
    pairs, squares = (np.sum(parts, axis=0) for parts in zip(*(_by_shift(raster, steps) for raster in rasters), strict=True))
    return _averaged(pairs, np.maximum(squares, 0.0), steps, gsd_m, reach, direction)


def _by_shift(values: NDArray[np.floating], steps: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the number of pairs of a raster, and the sum of their (z - z')^2, at each shift."""
    known = np.isfinite(values)
    if not known.any():
        return (np.zeros((steps[0] + 1, 2 * steps[1] + 1)),) * 2
    centred = np.where(known, values - np.mean(values[known], dtype=np.float64), 0.0).astype(np.float64)
    shape = tuple(fft.next_fast_len(size + step, real=True) for size, step in zip(values.shape, steps, strict=True))
    ones, first, second = (fft.rfft2(part, shape, workers=-1) for part in (known.astype(np.float64), centred, centred**2))
    pairs = np.rint(_shifts(fft.irfft2(np.abs(ones) ** 2, shape, workers=-1), steps))
    squares = _shifts(fft.irfft2(2 * (ones.conj() * second).real - 2 * np.abs(first) ** 2, shape, workers=-1), steps)
    return pairs, squares


def _shifts(correlation: FloatArray, steps: tuple[int, ...]) -> FloatArray:
    """Return the correlation at one half of the shifts, (steps_0 + 1, 2 steps_1 + 1).

    Rows start at a shift of 0 and columns at -steps_1. The other half is symmetric.
    """
    rows = correlation[: steps[0] + 1]
    return np.concatenate([rows[:, rows.shape[1] - steps[1] :], rows[:, : steps[1] + 1]], axis=1)


def _averaged(
    pairs: FloatArray, squares: FloatArray, steps: tuple[int, ...], gsd_m: float, reach: float, direction: Direction
) -> Variogram:
    """Average over the bins of distance. squares: sums of (z - z')^2 over each shift's pairs."""
    row, column = np.arange(steps[0] + 1)[:, None], np.arange(-steps[1], steps[1] + 1)[None]
    distance: FloatArray = gsd_m * np.hypot(row, column)
    wanted = (pairs > 0.5) & (distance > 0) & (distance <= reach * (1 + 1e-9)) & ~((row == 0) & (column < 0))
    if direction != "all":
        along, across = (np.abs(column), row) if direction == "x" else (row, np.abs(column))
        wanted &= across <= _SECTOR * along
    if not wanted.any():
        raise InputError(
            f"no two pixels with data lie within {reach:g} m of each other, so there is no variogram",
            where="variogram",
            remedy="allow a larger distance (largest_lag_m), or give maps with more data",
        )
    edges = np.geomspace(0.5, max(reach / gsd_m, 1.0) * (1 + 1e-6), _LAGS + 1) * gsd_m
    number = np.clip(np.searchsorted(edges, distance[wanted], side="right") - 1, 0, _LAGS - 1)
    count = np.bincount(number, pairs[wanted], _LAGS).astype(np.float64)
    filled = count > 0
    lag = np.bincount(number, pairs[wanted] * distance[wanted], _LAGS)[filled] / count[filled]
    return Variogram(lag, np.bincount(number, squares[wanted], _LAGS)[filled] / (2 * count[filled]), count[filled])


@dataclass(frozen=True)
class Structure:
    """One correlated part of the noise in a variogram model: a curve that rises with distance from 0 to its sill.

    Attributes
    ----------
    family : str
        Form of the curve: "spherical", "exponential" or "gaussian".
    sill_m2 : float
        Semivariance at large distances, m2, which is the variance of this part of the noise.
    range_m : float
        Effective range, m: distance at which (almost) all of the sill is reached.
    """

    family: Family
    sill_m2: float
    range_m: float

    def share(self, distance: FloatArray) -> FloatArray:
        """Return which share of its sill one part of a variogram model reaches at given distances, from 0 to 1.

        distance: any shape, m. Returns an array of the same shape.
        """
        t = np.asarray(distance) / self.range_m
        if self.family == "spherical":
            return np.where(t < 1, 1.5 * t - 0.5 * t**3, 1.0)
        return -np.expm1(-3 * (t if self.family == "exponential" else t**2))


@dataclass(frozen=True)
class VariogramModel:
    """Variogram model, how noise is correlated in space: uncorrelated noise (nugget) plus correlated parts (structures).

    Attributes
    ----------
    nugget_m2 : float
        Variance of the uncorrelated noise, m2.
    structures : tuple of Structure
        The correlated parts, by ascending range.
    relative_misfit : float
        RMS over the bins of (model / empirical semivariance - 1); 0 if the model was not fitted.
    """

    nugget_m2: float
    structures: tuple[Structure, ...]
    relative_misfit: float = 0.0

    @property
    def sill_m2(self) -> float:
        """Variance of the noise of a pixel, m2: the nugget (uncorrelated noise) plus the sills of all correlated parts."""
        return self.nugget_m2 + sum(part.sill_m2 for part in self.structures)

    def semivariance(self, distance: FloatArray) -> FloatArray:
        """Return the semivariance (half the mean squared difference of two pixels) that the model gives at distances, m2.

        distance: any shape, m. The semivariance is 0 at distance 0. Returns an array of the same shape.
        """
        total = self.nugget_m2 + sum(
            (part.sill_m2 * part.share(distance) for part in self.structures), np.zeros(np.shape(distance))
        )
        return np.where(np.asarray(distance) > 0, total, 0.0)

    def covariance(self, distance: FloatArray) -> FloatArray:
        """Return the covariance of the noise of two pixels at given distances, m2.

        distance: any shape, m. At distance 0 it is the variance of a pixel; elsewhere the nugget (uncorrelated noise) is left
        out.
        """
        return self.sill_m2 - self.semivariance(distance)

    def to_dict(self) -> dict[str, Any]:
        """Return all parameters of a variogram model as a dictionary for JSON; variances in m2, ranges in m."""
        return {**dataclasses.asdict(self), "sill_m2": self.sill_m2}

    def summary(self) -> str:
        """Describe a variogram model on one line for reports, with standard deviations in mm and ranges in m."""
        parts = [f"nugget {np.sqrt(self.nugget_m2) * 1e3:.1f} mm"]
        parts += [f"{part.family} {np.sqrt(part.sill_m2) * 1e3:.1f} mm over {part.range_m:.2g} m" for part in self.structures]
        return ", ".join(parts)


def fit_variogram(found: Variogram) -> VariogramModel:
    """Fit a variogram model to an empirical variogram, to describe over which distances the noise of a map is correlated.

    The model has a nugget (uncorrelated noise) and up to two correlated parts (structures). It has the smallest relative
    misfit over all bins of distance. Each further structure must reduce the squared misfit by at least 20 %. All bins
    have equal weight except those with few pairs of pixels: the model is assumed accurate to 3 %, and n pairs determine a
    semivariance to sqrt(2 / n).

    found: the empirical variogram.
    """
    if not found.semivariance_m2.max() > 0:
        return VariogramModel(0.0, ())
    best = _fitted(found, ())
    for count in (1, 2):
        if best.relative_misfit < _GOOD_ENOUGH:
            break
        tried = min((_fitted(found, (family,) * count) for family in _FAMILIES), key=lambda model: model.relative_misfit)
        if tried.relative_misfit**2 < _WORTH * best.relative_misfit**2:
            best = tried
    return best


def _fitted(found: Variogram, families: tuple[Family, ...]) -> VariogramModel:
    """Fit structures of given families: ranges by search, sills by non-negative least squares."""
    weight = 1 / np.sqrt(1 + 2 / (np.maximum(found.pairs, 1) * _MODEL_ERROR**2))
    lag, gamma = found.lag_m, np.maximum(found.semivariance_m2, 1e-6 * found.semivariance_m2.max())

    def solved(log_ranges: FloatArray) -> VariogramModel:
        ranges = np.sort(np.exp(log_ranges))
        units = [Structure(family, 1.0, float(a)) for family, a in zip(families, ranges, strict=True)]
        columns = np.stack([np.ones(len(lag)), *(unit.share(lag) for unit in units)], axis=1)
        sills, residual = optimize.nnls(columns / gamma[:, None] * weight[:, None], weight)
        parts = tuple(dataclasses.replace(unit, sill_m2=float(sill)) for unit, sill in zip(units, sills[1:], strict=True))
        return VariogramModel(float(sills[0]), parts, float(residual / np.linalg.norm(weight)))

    if not families:
        return solved(np.zeros(0))
    starts = np.geomspace(1.5 * lag[0], lag[-1], 6)
    pairs = [(a, b) for a in starts for b in starts if a < b] if len(families) == 2 else [(a,) for a in starts]
    begin = min((np.log(pair) for pair in pairs), key=lambda at: solved(at).relative_misfit)
    low, high = np.log(lag[0] / 2), np.log(3 * lag[-1])
    result = optimize.minimize(
        lambda at: solved(np.clip(at, low, high)).relative_misfit,
        begin,
        method="Nelder-Mead",
        options={"xatol": 1e-3, "fatol": 1e-6},
    )
    model = solved(np.clip(result.x, low, high))
    return dataclasses.replace(model, structures=tuple(part for part in model.structures if part.sill_m2 > 0))


def variance_of_mean(model: VariogramModel, mask: NDArray[np.bool_], gsd_m: float) -> float:
    """Return the variance of the mean of correlated noise over some pixels, m2, for example over the place of a fallen block.

    Parameters
    ----------
    model : VariogramModel
        Variogram model of the noise.
    mask : (h, w) bool array
        True for the pixels that are averaged.
    gsd_m : float
        Side of a pixel, m.

    Raises
    ------
    ValueError
        If the mask is empty.
    """
    count = int(np.count_nonzero(mask))
    if count == 0:
        raise ValueError("the mask is empty")
    shape = tuple(fft.next_fast_len(2 * size - 1, real=True) for size in mask.shape)
    pairs = np.rint(fft.irfft2(np.abs(fft.rfft2(mask.astype(np.float64), shape, workers=-1)) ** 2, shape, workers=-1))
    row, column = (np.minimum(np.arange(size), size - np.arange(size)) for size in shape)
    distance = gsd_m * np.hypot(row[:, None], column[None])
    used = pairs > 0
    return float(np.sum(pairs[used] * model.covariance(distance[used])) / count**2)


def effective_sample_size(model: VariogramModel, mask: NDArray[np.bool_], gsd_m: float) -> float:
    """Return how many independent pixels would give a mean with the same variance as the correlated pixels of a mask.

    Parameters
    ----------
    model : VariogramModel
        Variogram model of the noise.
    mask : (h, w) bool array
        True for the pixels that are averaged.
    gsd_m : float
        Side of a pixel, m.

    Returns
    -------
    float
        The number, from 1 to the number of the mask's pixels.

    Raises
    ------
    ValueError
        If the mask is empty.
    """
    variance = variance_of_mean(model, mask, gsd_m)
    return (
        float(np.clip(model.sill_m2 / variance, 1.0, np.count_nonzero(mask))) if variance > 0 else float(np.count_nonzero(mask))
    )
