"""Tell white from grid-correlated noise of disparities (bilinear between nodes) by the semivariogram.

Half the mean squared difference of two pixels h apart (the semivariogram) is, beyond what the model predicts,

    g(h) = w + r^2 (4/9 - B(hx / s) B(hy / s)) + c h^2

w: variance of white noise; r, s: standard deviation and step of the grid; B: cubic B-spline (2/3 at 0, 0 from 2 on: two hat
functions convolved); c h^2: error of the reference, which is smooth. That error may also be a process of correlation exp(-h^2 / 2
l^2), which is small if its length l on the wall is short.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.disparity_raster import cell_numbers, raster_spacing_px
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.models.sensor_model import StereoModel

_LAGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
_LONGEST_LAG_PX = (256.0, 128.0, 64.0)
"""Longest lag, px: the first for which enough wall blocks contain pairs."""
_GRID_STEPS_PX = tuple(8.0 * 2 ** (quarter / 4) for quarter in range(17))
_POINTS_PER_BLOCK = 400.0
_FEWEST_BLOCKS, _FEWEST_LAGS = 12, 3
_CLIP = 4.5
_RIDGE, _SHRINKAGE_PER_LAG = 0.02, 0.2
"""Shares of the covariance of lags that are added to its diagonal: one always, one times the number of lags per wall block,
because a covariance of few blocks is inexact."""
_DRAWS = 1999
_FINEST_GRID = 2.0
"""Narrowest grid that is tried, in cells of the disparity raster (sampling theorem)."""
_REFERENCE_LENGTHS_M = tuple(0.45 * 2 ** (half / 2) for half in range(-4, 9))
"""Correlation lengths of the reference error that are tried (standard deviations of a Gaussian), m."""


@dataclass(frozen=True)
class _Variogram:
    """Empirical semivariogram in excess of the model.

    Attributes
    ----------
    step : step of the raster along its coarser axis, px.
    lag : (k, 2) lags, px.
    blocks : (k, b) contribution of each of b wall blocks, px^2, weighted by its share of the points.
    root : (k, k) whitens their sum: root @ value has unit variance.
    distance_m : (k,) lags on the wall, m.
    unit_m : depth of one px of disparity, m.
    """

    step: float
    lag: FloatArray
    blocks: FloatArray
    root: FloatArray
    distance_m: FloatArray
    unit_m: float

    @property
    def value(self) -> FloatArray:
        """(k,) semivariogram of all blocks, px^2."""
        return np.asarray(self.blocks.sum(axis=1))

    def fitted(self, shape: FloatArray) -> _VariogramFit:
        """Fit a shape (k,) beside a smooth error of the reference, both not negative, the latter bounded."""
        columns, value = self.root @ np.stack([shape, self._smooth], axis=1), self.root @ self.value
        weights = np.linalg.pinv(columns)
        smooth = float(weights[1] @ value)
        largest = self._variance(thresholds().points.reference_error)
        if not 0 <= smooth <= largest:
            value = value - np.clip(smooth, 0, largest) * columns[:, 1]
            columns = columns[:, :1]
            weights = np.linalg.pinv(columns)
        best = weights @ value
        chi2 = float(np.sum((value - columns @ best) ** 2))
        shares = weights[0] @ self.root @ self.blocks
        misfit_factor = np.sqrt(max(chi2 / (len(value) - columns.shape[1]), 1.0))  # larger than 1 if no shape fits
        error = max(misfit_factor * float(np.linalg.norm(weights[0])), float(np.linalg.norm(shares - shares.mean())))
        return _VariogramFit(chi2, float(best[0]), error)

    def p_value(self, random: KeyedRandom) -> float:
        """Return the p-value (1 + b) / (1 + N) of the largest grid variance over its error, for any step.

        The null distribution has the signs flipped by wall block. Blocks of noise that the model contains deviate to both sides
        alike. Lags are weighted by their own scatter, because weights from the covariance of so few blocks would be fitted to
        these very blocks.
        """
        size = np.linalg.norm(self.blocks, axis=1)
        forms = (np.stack([self._grid(step), self._smooth], axis=1) for step in self._steps)
        weights = np.stack([np.linalg.pinv(shape / size[:, None])[0] / size for shape in forms])
        shares = weights @ self.blocks
        shares /= np.linalg.norm(shares, axis=1, keepdims=True)
        signs = random.child("nodes").generator().choice([-1.0, 1.0], size=(shares.shape[1], _DRAWS))
        largest = np.max(shares @ signs, axis=0)
        return float((1 + np.sum(largest >= np.max(shares.sum(axis=1)))) / (1 + _DRAWS))

    @property
    def _steps(self) -> list[float]:
        """Steps of grids, px, for which the raster is fine enough."""
        return [step for step in _GRID_STEPS_PX if step >= _FINEST_GRID * self.step]

    def _grid(self, step: float) -> FloatArray:
        """(k,) semivariogram of grid noise whose nodes have variance 1."""
        return RegularizationNoise(sigma_px=1.0, step_px=step).semivariogram(self.lag)

    @property
    def _smooth(self) -> FloatArray:
        """(k,) semivariogram of a smooth error of the reference, scaled to 1."""
        found = np.sum(self.lag**2, axis=1)
        return np.asarray(found / found.max())

    @property
    def chi2_without_grid(self) -> float:
        """chi^2 of white noise, or of a smooth error of the reference."""
        white = self.fitted(np.ones(len(self.lag))).chi2
        return min(white, self._chi2_of(self._smooth, thresholds().points.reference_error))

    @property
    def chi2_of_reference_error(self) -> float:
        """Return chi^2 of the best fit without grid noise.

        Errors of the reference of all correlation lengths are tried; below 1 m, the bound falls in proportion to the length.
        """
        most_m, chi2 = thresholds().points.reference_error, self.chi2_without_grid
        for length_m in _REFERENCE_LENGTHS_M:
            chi2 = min(chi2, self._chi2_of(1 - np.exp(-0.5 * (self.distance_m / length_m) ** 2), most_m * min(length_m, 1.0)))
        return chi2

    def _chi2_of(self, shape: FloatArray, most_m: float) -> float:
        """chi^2 of an error of the reference (k,) alone, with a bounded standard deviation."""
        column, value = self.root @ shape, self.root @ self.value
        return float(np.sum((value - np.clip(column @ value / (column @ column), 0, self._variance(most_m)) * column) ** 2))

    def _variance(self, error_m: float) -> float:
        """px^2 of an error along the depth, m."""
        return (error_m / self.unit_m) ** 2

    def best_grid(self) -> tuple[_VariogramFit, float, list[float]] | None:
        """Return the fit in the middle of those that are best, its step, px, and the steps of all of them.

        None if all steps are too fine.
        """
        trials = [(self.fitted(self._grid(step)), step) for step in self._steps]
        least = min((fit.chi2 for fit, _ in trials), default=np.inf)
        near = [trial for trial in trials if trial[0].chi2 < least + 1]
        return (*near[len(near) // 2], [step for _, step in near]) if near else None


@dataclass(frozen=True)
class _VariogramFit:
    """A fitted semivariogram. chi2: chi^2 of the fit; variance, error: variance and its standard deviation, px^2."""

    chi2: float
    variance: float
    error: float


def separate_white_and_grid_noise(
    found: list[VarianceTerm], part: StereoResiduals, value: FloatArray, model: StereoModel
) -> list[VarianceTerm]:
    """Decide whether noise that was taken for white is independent from point to point, or grid-correlated.

    Grid-correlated noise comes from a stereo matcher that interpolates between widely spaced pixels (grid nodes). The
    semivariogram of the residuals decides. If it supports neither kind over the other, both are reported as indistinguishable.
    Grid-correlated noise also replaces a variance that depends on a covariate such as the depth, because points of similar
    depth may belong to few nodes.

    Parameters
    ----------
    found : noise terms that were fitted as white noise.
    part : disparity residuals of n points with their predicted standard deviations, px.
    value : (n,) their values after the systematic effects are removed, px.
    model : sensor model of the stereo pair.

    Returns
    -------
    list : the noise terms, white or grid-correlated, that the semivariogram supports.
    """
    variogram = _variogram(part, value, model) if found else None
    named = [_name_noise(replace(each, empirical=False), variogram) for each in found]
    return [old if old.empirical and new.effect == old.effect else new for old, new in zip(found, named, strict=True)]


def find_grid_noise(
    part: StereoResiduals, value: FloatArray, model: StereoModel, random: KeyedRandom
) -> tuple[VarianceTerm | None, str]:
    """Find noise that neighbouring points share because the matcher interpolates it between widely spaced pixels (grid nodes).

    It needs a search of its own: points near one node hardly differ by it, so it hardly shows in the deviations from a plane
    within small squares of the wall, to which other noise terms are fitted.

    Parameters
    ----------
    part : disparity residuals of n points.
    value : (n,) residuals after the systematic effects, px.
    model : sensor model of the pair.
    random : source of random numbers for the null distribution.

    Returns
    -------
    tuple : the grid-correlated noise term or None; and a note if the reference surface may be the cause, else "".
    """
    variogram = _variogram(part, value, model)
    best = None if variogram is None else variogram.best_grid()
    if variogram is None or best is None:
        return None, ""
    fit, step, near = best
    needed = 2 * thresholds().variance.least_gain  # chi^2 is twice a log-likelihood
    if fit.chi2 >= variogram.chi2_without_grid - needed or fit.variance <= thresholds().edges.block_sigmas * fit.error:
        return None, ""
    without = variogram.chi2_of_reference_error
    if fit.chi2 >= without - needed:
        return None, _describe_reference_error(fit, step, variogram.unit_m)
    name, p_value = RegularizationNoise.tag(), variogram.p_value(random)
    found = VarianceTerm(name, (), p_value, (without - fit.chi2) / 2, {}, {}, False, np.zeros(len(part)))
    return _as_grid_noise(found, fit, step, near), ""


def _describe_reference_error(fit: _VariogramFit, step: float, unit_m: float) -> str:
    """Note on an error that the reference may have."""
    sigma = np.sqrt(RegularizationNoise(sigma_px=1.0).total_variance * fit.variance)
    return (
        f"disparities share an error of {sigma:.2g} px over about {step:.0f} px ({fit.variance / fit.error:.2g} standard "
        f"deviations). An error of the reference of {1e3 * sigma * unit_m:.2g} mm, correlated over as much of the wall, would "
        "look the same, so it is attributed to the reference; a better reference would separate the two"
    )


def _name_noise(white: VarianceTerm, variogram: _Variogram | None) -> VarianceTerm:
    """The term of white noise, of grid noise, or of white noise with grid noise in its class."""
    both = replace(white, indistinguishable=tuple(sorted({*white.indistinguishable, RegularizationNoise.tag()})))
    if variogram is None:
        return both
    white_fit = variogram.fitted(np.ones(len(variogram.lag)))
    if white_fit.variance > 0:
        both = _with_variance(both, white_fit, 1.0)
    resolved = _FINEST_GRID * variogram.step <= _GRID_STEPS_PX[0]  # otherwise a grid may be too fine for this raster
    white = replace(both, indistinguishable=white.indistinguishable) if resolved else both
    best = variogram.best_grid()
    if best is None or white_fit.chi2 < best[0].chi2 - thresholds().mean.class_margin:
        return white
    if best[0].variance <= 0 or white_fit.chi2 < best[0].chi2 + thresholds().mean.class_margin:
        return both
    grid = replace(white, effect=RegularizationNoise.tag(), indistinguishable=())
    return _as_grid_noise(grid, *best)


def _as_grid_noise(found: VarianceTerm, fit: _VariogramFit, step: float, near: list[float]) -> VarianceTerm:
    """The noise term with the parameters of a grid."""
    grid = _with_variance(found, fit, RegularizationNoise(sigma_px=1.0).total_variance)
    parameters, std = {**grid.parameters, "step_px": step}, {**grid.std, "step_px": max(float(np.std(near)), 0.2 * step)}
    return replace(grid, parameters=parameters, std=std)


def _with_variance(found: VarianceTerm, fit: _VariogramFit, share: float) -> VarianceTerm:
    """The noise term with the standard deviation sigma_px of a fitted variance. share: mean share of it that a disparity has."""
    sigma = float(np.sqrt(fit.variance))
    return replace(
        found,
        parameters={"sigma_px": sigma},
        std={"sigma_px": fit.error / (2 * sigma)},
        variance=np.full(len(found.variance), share * fit.variance),
    )


def _variogram(part: StereoResiduals, value: FloatArray, model: StereoModel) -> _Variogram | None:
    """Compute the semivariogram along rows and columns, with its covariance from wall blocks.

    None if the pixels are on no raster.
    """
    g = part.geometry
    steps = [step for step in (raster_spacing_px(g.v), raster_spacing_px(g.u)) if step is not None]
    if len(steps) < 2:
        return None
    row, column = cell_numbers(g.v, steps[0]), cell_numbers(g.u, steps[1])
    bound = _CLIP * nmad(value)
    raster = np.full((int(row.max()) + 1, int(column.max()) + 1), np.nan)
    raster[row, column] = np.where(np.abs(value) < bound, value, np.nan)
    block = np.zeros(raster.shape, dtype=np.int64)
    block[row, column] = wall_blocks_by_points(part.wall_xy, _POINTS_PER_BLOCK)
    count = int(block.max()) + 1
    lags = [(axis, lag) for axis in (0, 1) for lag in _LAGS if lag * steps[axis] <= _LONGEST_LAG_PX[0]]
    pairs, sums = np.stack([_pairs_by_block(raster, block, lag, axis, count) for axis, lag in lags], axis=1)
    offsets = np.array([[lag * steps[axis] * (axis == 1), lag * steps[axis] * (axis == 0)] for axis, lag in lags])
    near = _usable_lags(pairs, offsets.sum(axis=1))
    pairs, sums, offsets = pairs[near], sums[near], offsets[near]
    full = (pairs > 0).all(axis=0)
    if full.sum() < _FEWEST_BLOCKS or len(offsets) < 2 * _FEWEST_LAGS:
        return None
    means = sums[:, full] / pairs[:, full]
    weight = pairs[:, full].sum(axis=0) / pairs[:, full].sum()
    mean = means @ weight
    left = (means - mean[:, None]) * np.sqrt(weight)
    covariance = left @ left.T / (1 - np.sum(weight**2)) * np.sum(weight**2)
    covariance += (_RIDGE + _SHRINKAGE_PER_LAG * len(mean) / means.shape[1]) * np.diag(np.diag(covariance))
    # variance of effects that were found separately, such as pixel locking
    white = max(float(np.median(part.sigma**2)) - model.variance, 0.0)
    blocks = (means - (model.semivariogram(offsets) + white)[:, None]) * weight
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    metres_per_px = np.sqrt(np.prod(np.std(part.wall_xy, axis=0)) / (np.std(g.u) * np.std(g.v)))
    on_wall = np.linalg.norm(offsets, axis=1) * float(metres_per_px)
    return _Variogram(max(steps), offsets, blocks, root, on_wall, float(np.median(part.unit_m)))


def _usable_lags(pairs: FloatArray, length: FloatArray) -> BoolArray:
    """(k,) lags short enough for a dozen wall blocks to have pairs (k, b) of all of them. length: (k,) px."""
    for longest in _LONGEST_LAG_PX[:-1]:
        near = length <= longest
        if (pairs[near] > 0).all(axis=0).sum() >= _FEWEST_BLOCKS:
            return np.asarray(near)
    return np.asarray(length <= _LONGEST_LAG_PX[-1])


def _pairs_by_block(
    raster: FloatArray, block: NDArray[np.int64], lag: int, axis: int, count: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """(count,) pairs and half their squared differences, by the wall block of the first of each pair."""
    first, second = ((*[slice(None)] * axis, rows) for rows in (slice(-lag), slice(lag, None)))
    half = 0.5 * (raster[first] - raster[second]) ** 2
    known = np.isfinite(half)
    there = block[first][known]
    return np.bincount(there, minlength=count), np.bincount(there, half[known], count)
