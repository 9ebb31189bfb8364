"""White noise of a disparity, or noise on the nodes of a grid: told apart by how neighbours differ.

Half the mean squared difference of two pixels h apart (the semivariogram) is, beyond what the model predicts,

    g(h) = w + r^2 (4/9 - B(hx / s) B(hy / s)) + c h^2

w the variance of white noise, r and s the standard deviation and the step of a grid of nodes that is interpolated bilinearly, B
the cubic B-spline (2/3 at 0, 0 from 2 on: two hat functions convolved), and c h^2 the reference's error, which is smooth. That
may also be a process of correlation exp(-h^2 / 2 l^2), small where its length l on the wall is short.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.gap.decisions import decided
from pipeline.gap.other.spread import SpreadFound
from pipeline.gap.residuals.disparity_raster import raster_spacing_px
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.stereo_residuals import StereoResiduals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.models.sensor_model import StereoModel

_LAGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
_LONGEST_PX = (256.0, 128.0, 64.0)
"""Of a lag: the first that enough blocks of the wall have pairs of."""
_STEPS_PX = tuple(8.0 * 2 ** (quarter / 4) for quarter in range(17))
_POINTS_PER_BLOCK = 400.0
_FEWEST_BLOCKS, _FEWEST_LAGS = 12, 3
_CLIP = 4.5
_RIDGE, _FEW = 0.02, 0.2
"""Share of the covariance of lags added to its diagonal: always, and times lags per block of the wall: few blocks mistake it."""
_DRAWS = 1999
_LENGTHS = tuple(2 ** (half / 2) for half in range(-4, 9))
"""Of correlation that the reference's error is tried with, times the one from which on it may be large."""


@dataclass(frozen=True)
class _Variogram:
    """step: px of the raster, along its coarser axis; lag: (k, 2) px; blocks: (k, b) px^2 less what the model predicts, of each
    block of the wall times its share of all points; root: (k, k) whitens their sum (root @ value has unit variance); distance_m:
    (k,) of the lags on the wall; unit_m: metres of depth per px of disparity."""

    step: float
    lag: FloatArray
    blocks: FloatArray
    root: FloatArray
    distance_m: FloatArray
    unit_m: float

    @property
    def value(self) -> FloatArray:
        """(k,) of all blocks, px^2."""
        return np.asarray(self.blocks.sum(axis=1))

    def fitted(self, form: FloatArray) -> _Form:
        """A form (k,) beside the reference's error, both at least 0, and that no more than there may be."""
        columns, value = self.root @ np.stack([form, self._smooth], axis=1), self.root @ self.value
        weights = np.linalg.pinv(columns)
        smooth = float(weights[1] @ value)
        most = self._variance(decided().nodes.reference_error)
        if not 0 <= smooth <= most:
            value = value - np.clip(smooth, 0, most) * columns[:, 1]
            columns = columns[:, :1]
            weights = np.linalg.pinv(columns)
        best = weights @ value
        square = float(np.sum((value - columns @ best) ** 2))
        shares = weights[0] @ self.root @ self.blocks
        worse = np.sqrt(max(square / (len(value) - columns.shape[1]), 1.0))  # than a form of the right kind would fit
        error = max(worse * float(np.linalg.norm(weights[0])), float(np.linalg.norm(shares - shares.mean())))
        return _Form(square, float(best[0]), error, shares)

    def p_value(self, random: KeyedRandom) -> float:
        """Of the largest variance of nodes over its error, whichever the step, by signs drawn block by block: (1 + b) / (1 + N).

        Blocks of noise that the model holds deviate to either side alike. Lags have the weights that their own scatter gives
        them: weights by the covariance of so few blocks would fit just these.
        """
        size = np.linalg.norm(self.blocks, axis=1)
        forms = (np.stack([_nodes(self.lag, step), self._smooth], axis=1) for _, step in self._trials)
        weights = np.stack([np.linalg.pinv(form / size[:, None])[0] / size for form in forms])
        shares = weights @ self.blocks
        shares /= np.linalg.norm(shares, axis=1, keepdims=True)
        signs = random.child("nodes").generator().choice([-1.0, 1.0], size=(shares.shape[1], _DRAWS))
        largest = np.max(shares @ signs, axis=0)
        return float((1 + np.sum(largest >= np.max(shares.sum(axis=1)))) / (1 + _DRAWS))

    @property
    def _trials(self) -> list[tuple[_Form, float]]:
        """Grids of nodes and their steps, px, that the raster is not too coarse for."""
        finest = decided().nodes.finest * self.step
        return [(self.fitted(_nodes(self.lag, step)), step) for step in _STEPS_PX if step >= finest]

    @property
    def _smooth(self) -> FloatArray:
        """(k,) form of the reference's error."""
        found = np.sum(self.lag**2, axis=1)
        return np.asarray(found / found.max())

    @property
    def plain_square(self) -> float:
        """chi^2 of white noise, or of a smooth error of the reference."""
        white = self.fitted(np.ones(len(self.lag))).square
        return min(white, self._square_of(self._smooth, decided().nodes.reference_error))

    @property
    def reference_square(self) -> float:
        """chi^2 of the best form without nodes: errors of the reference of all lengths too, small where they are short."""
        by = decided().nodes
        square = self.plain_square
        for length in _LENGTHS:
            form = 1 - np.exp(-0.5 * (self.distance_m / (length * by.reference_length)) ** 2)
            most = by.reference_error if length >= 1 else by.reference_relief
            square = min(square, self._square_of(form, most))
        return square

    def _square_of(self, form: FloatArray, most_m: float) -> float:
        """chi^2 of an error of the reference (k,) alone, of a standard deviation of so much at the most."""
        column, value = self.root @ form, self.root @ self.value
        return float(np.sum((value - np.clip(column @ value / (column @ column), 0, self._variance(most_m)) * column) ** 2))

    def _variance(self, error_m: float) -> float:
        """px^2 of an error along the depth."""
        return (error_m / self.unit_m) ** 2

    def best_nodes(self) -> tuple[_Form, float, list[float]] | None:
        """The grid of nodes in the middle of those that fit best, its step, px, and their steps; None where all are too fine."""
        trials = self._trials
        if not trials:
            return None
        least = min(form.square for form, _ in trials)
        near = [trial for trial in trials if trial[0].square < least + 1]
        return *near[len(near) // 2], [step for _, step in near]


@dataclass(frozen=True)
class _Form:
    """A form of the semivariogram fitted. square: chi^2; variance and its standard deviation, px^2; blocks: (b,) shares of the
    variance."""

    square: float
    variance: float
    error: float
    blocks: FloatArray


def told_apart(found: list[SpreadFound], part: StereoResiduals, value: FloatArray, model: StereoModel) -> list[SpreadFound]:
    """Noise that was taken for white, named by how neighbours differ; a class of both where that does not tell.

    Noise on nodes seems to change with any covariate, as few of them have one value of it: it goes before an empirical term.
    value: (n,) residuals without the mean effects found.
    """
    named = [_named(replace(each, name=each.effect, empirical=False), part, value, model) for each in found]
    return [old if old.empirical and new.name == old.effect else new for old, new in zip(found, named, strict=True)]


def find_nodes(
    part: StereoResiduals, value: FloatArray, model: StereoModel, random: KeyedRandom
) -> tuple[SpreadFound | None, str]:
    """Noise on nodes so far apart that the points around one do not differ by it; None and words where the reference may be wrong
    by as much, None and "" where there is none.

    value: (n,) residuals without the mean effects found.
    """
    variogram = _variogram(part, value, model)
    best = None if variogram is None else variogram.best_nodes()
    if variogram is None or best is None:
        return None, ""
    form, step, near = best
    by = decided().nodes
    if form.square >= variogram.plain_square - by.least_gain or form.variance <= by.least_sigmas * form.error:
        return None, ""
    without = variogram.reference_square
    if form.square >= without - by.least_gain:
        return None, _as_reference(form, step, variogram.unit_m)
    name, p_value = RegularizationNoise.tag(), variogram.p_value(random)
    found = SpreadFound(name, name, (), p_value, (without - form.square) / 2, {}, {}, False, np.zeros(len(part)))
    return _on_nodes(found, form, step, near), ""


def _as_reference(form: _Form, step: float, unit_m: float) -> str:
    """Words for an error that the reference may have."""
    sigma = np.sqrt(RegularizationNoise(sigma_px=1.0).total_variance * form.variance)
    return (
        f"disparities share an error of {sigma:.2g} px over some {step:.0f} px ({form.variance / form.error:.2g} standard "
        f"deviations): a reference that is wrong by {1e3 * sigma * unit_m:.2g} mm, alike over as much of the wall, would show "
        "the same, so this is taken for its error; a better reference would tell"
    )


def _named(white: SpreadFound, part: StereoResiduals, value: FloatArray, model: StereoModel) -> SpreadFound:
    both = replace(white, alike=tuple(sorted({*white.alike, RegularizationNoise.tag()})))
    variogram = _variogram(part, value, model)
    if variogram is None:
        return both
    plain = variogram.fitted(np.ones(len(variogram.lag)))
    if plain.variance > 0:
        both = _with_variance(both, plain, 1.0)
    resolved = decided().nodes.finest * variogram.step <= _STEPS_PX[0]  # else a grid may be too fine for this raster to tell
    white = replace(both, alike=white.alike) if resolved else both
    best = variogram.best_nodes()
    if best is None or plain.square < best[0].square - decided().nodes.margin:
        return white
    if best[0].variance <= 0 or plain.square < best[0].square + decided().nodes.margin:
        return both
    nodes = replace(white, name=RegularizationNoise.tag(), effect=RegularizationNoise.tag(), alike=())
    return _on_nodes(nodes, *best)


def _on_nodes(found: SpreadFound, form: _Form, step: float, near: list[float]) -> SpreadFound:
    """With the parameters of a grid of nodes."""
    nodes = _with_variance(found, form, RegularizationNoise(sigma_px=1.0).total_variance)
    parameters, std = {**nodes.parameters, "step_px": step}, {**nodes.std, "step_px": max(float(np.std(near)), 0.2 * step)}
    return replace(nodes, parameters=parameters, std=std)


def _with_variance(found: SpreadFound, form: _Form, share: float) -> SpreadFound:
    """With the standard deviation sigma_px that a variance with its error gives. share: of it that a disparity has on average."""
    sigma = float(np.sqrt(form.variance))
    return replace(
        found,
        parameters={"sigma_px": sigma},
        std={"sigma_px": form.error / (2 * sigma)},
        variance=np.full(len(found.variance), share * form.variance),
    )


def _variogram(part: StereoResiduals, value: FloatArray, model: StereoModel) -> _Variogram | None:
    """Along rows and columns, with its covariance by blocks of the wall; None where the pixels are on no raster."""
    g = part.geometry
    steps = [step for step in (raster_spacing_px(g.v), raster_spacing_px(g.u)) if step is not None]
    if len(steps) < 2:
        return None
    row, column = (np.rint((x - x.min()) / step).astype(np.int64) for x, step in zip((g.v, g.u), steps, strict=True))
    bound = _CLIP * nmad(value)
    raster = np.full((int(row.max()) + 1, int(column.max()) + 1), np.nan)
    raster[row, column] = np.where(np.abs(value) < bound, value, np.nan)
    block = np.zeros(raster.shape, dtype=np.int64)
    block[row, column] = wall_blocks_by_points(part.wall_xy, _POINTS_PER_BLOCK)
    count = int(block.max()) + 1
    lags = [(axis, lag) for axis in (0, 1) for lag in _LAGS if lag * steps[axis] <= _LONGEST_PX[0]]
    pairs, sums = np.stack([_by_block(raster, block, lag, axis, count) for axis, lag in lags], axis=1)
    near = _near(pairs, np.array([lag * steps[axis] for axis, lag in lags]))
    lags = [each for each, is_near in zip(lags, near, strict=True) if is_near]
    pairs, sums = pairs[near], sums[near]
    full = (pairs > 0).all(axis=0)
    if full.sum() < _FEWEST_BLOCKS or len(lags) < 2 * _FEWEST_LAGS:
        return None
    means = sums[:, full] / pairs[:, full]
    weight = pairs[:, full].sum(axis=0) / pairs[:, full].sum()
    mean = means @ weight
    left = (means - mean[:, None]) * np.sqrt(weight)
    covariance = left @ left.T / (1 - np.sum(weight**2)) * np.sum(weight**2)
    covariance += (_RIDGE + _FEW * len(mean) / means.shape[1]) * np.diag(np.diag(covariance))
    offsets = np.array([[lag * steps[axis] * (axis == 1), lag * steps[axis] * (axis == 0)] for axis, lag in lags])
    white = max(float(np.median(part.sigma**2)) - model.variance, 0.0)  # of what was found apart, such as a locking
    blocks = (means - (model.semivariogram(offsets) + white)[:, None]) * weight
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    on_wall = np.linalg.norm(offsets, axis=1) * _wall_per_px(part)
    return _Variogram(max(steps), offsets, blocks, root, on_wall, float(np.median(part.unit_m)))


def _wall_per_px(part: StereoResiduals) -> float:
    """Metres on the wall per px of the image, along rows and columns together."""
    g = part.geometry
    return float(np.sqrt(np.prod(np.std(part.wall_xy, axis=0)) / (np.std(g.u) * np.std(g.v))))


def _near(pairs: FloatArray, length: FloatArray) -> BoolArray:
    """(k,) lags that are short enough for a dozen blocks of the wall to have pairs (k, b) of all of them. length: (k,) px."""
    for longest in _LONGEST_PX[:-1]:
        near = length <= longest
        if (pairs[near] > 0).all(axis=0).sum() >= _FEWEST_BLOCKS:
            return np.asarray(near)
    return np.asarray(length <= _LONGEST_PX[-1])


def _by_block(raster: FloatArray, block: NDArray[np.int64], lag: int, axis: int, count: int) -> tuple[FloatArray, FloatArray]:
    """(count,) pairs and half their squared differences, by the block of the first of each pair."""
    first, second = (raster[:-lag], raster[lag:]) if axis == 0 else (raster[:, :-lag], raster[:, lag:])
    there = block[:-lag] if axis == 0 else block[:, :-lag]
    half = 0.5 * (first - second) ** 2
    known = np.isfinite(half)
    return (
        np.bincount(there[known], minlength=count).astype(np.float64),
        np.bincount(there[known], half[known], count).astype(np.float64),
    )


def _nodes(lag: FloatArray, step: float) -> FloatArray:
    """(k,) semivariogram of a grid of nodes of variance 1."""
    return RegularizationNoise(sigma_px=1.0, step_px=step).semivariogram(lag)
