"""Fit the variance model: which noise terms explain the squared deviations within cells, by the Gaussian likelihood.

sigma_i^2 = predicted variance + sum_k theta_k f_k(i), theta_k >= 0, for candidate terms f_k of the catalogue.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.change.robust import nmad
from pipeline.gap.noise_and_edges.sign_flips import null_p_value
from pipeline.gap.residuals.residuals import BoolArray, Geometry, Residuals
from pipeline.gap.residuals.wall_blocks import WallCells, wall_block_numbers
from pipeline.gap.thresholds import equivalence_margin, thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn

_LEAST_REMAINING_VARIANCE = 0.3
"""Least share of a point's variance that the plane of its cell must leave."""
_LEAST_WHITE_SHARE, _EXPECTATION_DRAWS = 0.02, 10
"""Least share of a point's variance that counts as white noise; number of simulations of correlated noise."""
_BINS = 8
_LINE_DIGITS, _FEWEST_IN_LINE, _LONGEST_CYCLE = 3, 10, 16
"""Decimals of the coordinates of image rows and columns; mean number of points in each that is needed to bin by them; longest
cycle of lines, as of the channels of a laser scanner, in which the noise may differ."""
_CLIP_SIGMAS = 12.0
"""Standard deviations at which outliers are clipped."""
_HIGHEST_QUANTILE = 0.999
"""Quantile of a candidate's variance above which it is clipped."""
_FISHER_ROUNDS = 25


@dataclass(frozen=True)
class VarianceCandidate:
    """A noise effect to fit: the variance that it adds at each of n points, as a sum of k fitted terms, one for each parameter.

    A fitted factor theta multiplies the variance that a parameter adds at its typical size (1: typical size).

    Attributes
    ----------
    name : name of the effect.
    variance : (n, k) variance that each parameter adds at its typical size, squared unit of the observable (m² or px²).
    scale : (k,) typical sizes; the value of a parameter is scale * sqrt(theta).
    names : (k,) names of the parameters.
    cost : penalty subtracted from the log-likelihood ratio: the number of parameters, with those in `fixed`.
    fixed : values, by name, of parameters that are not fitted; each of a few trial values makes a candidate of its own.
    """

    name: str
    variance: FloatArray
    scale: tuple[float, ...]
    names: tuple[str, ...]
    cost: float = 1.0
    fixed: Mapping[str, float] = field(default_factory=dict)

    def parameters(self, theta: FloatArray) -> dict[str, float]:
        """Convert fitted factors of the variance to values of the noise effect's parameters, by name.

        theta: (k,) factors; 1 is the variance at a parameter's typical size.
        """
        return dict(zip(self.names, map(float, np.sqrt(theta) * np.array(self.scale)), strict=True)) | dict(self.fixed)

    def standard_deviations(self, theta: FloatArray, error: FloatArray) -> dict[str, float]:
        """Return the standard deviations of a noise effect's parameters by name.

        They follow from those of the fitted factors of the variance. If a factor is below its standard deviation, the parameter
        may be 0; the returned value is then the size at which the factor equals its standard deviation.

        Parameters
        ----------
        theta : (k,) fitted factors of the variance; 1 is the variance at a parameter's typical size.
        error : (k,) standard deviations of theta.
        """
        root = np.sqrt(theta)
        std = np.where(theta > error, error / np.maximum(2 * root, 1e-300), np.sqrt(error))
        return dict(zip(self.names, map(float, std * np.array(self.scale)), strict=True))


@dataclass(frozen=True)
class VarianceTerm:
    """A noise term that was found: it explains variance of the residuals that the sensor model does not predict.

    Attributes
    ----------
    name : name of the noise effect; for an empirical term, the covariate on which the variance depends.
    effect : name of the effect of the catalogue that represents the term in a sensor model.
    indistinguishable : names of other effects that would explain the variance as well.
    p_value : p-value from the simulated null distribution.
    gain : log-likelihood ratio of the models with and without it.
    parameters, std : values of the effect's parameters and their standard deviations, by parameter name.
    empirical : true if no effect of the catalogue fits well, so that a variance fitted freely to a covariate is reported.
    variance : (n,) variance that it adds at each point, squared unit of the observable (m² or px²).
    """

    name: str
    effect: str
    indistinguishable: tuple[str, ...]
    p_value: float
    gain: float
    parameters: dict[str, float]
    std: dict[str, float]
    empirical: bool
    variance: FloatArray

    def with_constant_variance(self, count: int) -> VarianceTerm:
        """Return this noise term for other points, as noise that is the same everywhere: each gets the mean of its variances.

        count: number of the other points.
        """
        return replace(self, variance=np.full(count, float(self.variance.mean())))


@dataclass(frozen=True)
class _BinnedVariance:
    """A noise variance that is fitted separately in each bin of a covariate.

    name: the covariate; gain: log-likelihood ratio; score: gain minus the number of bins; added: (n,) variance that it adds.
    """

    name: str
    gain: float
    score: float
    added: FloatArray


@dataclass(frozen=True)
class VarianceScore:
    """How well one noise term explains the squared residuals.

    Attributes
    ----------
    name : name of the effect; for a variance fitted freely to a covariate (empirical term), that covariate.
    gain : log-likelihood ratio of the models with and without the term.
    score : gain minus the number of parameters.
    empirical : whether the term is not in the catalogue.
    """

    name: str
    gain: float
    score: float
    empirical: bool = False


def standardised_deviations(residuals: Residuals, cells: WallCells, value: FloatArray) -> FloatArray:
    """Return residuals minus a plane fitted in each small square (cell) of the wall, over the predicted standard deviation.

    Noise is fitted to them: they have variance 1 if the noise model is right. The planes remove the error of the reference,
    which is correlated over metres.

    Parameters
    ----------
    residuals : residuals of n points with their predicted standard deviations.
    cells : the cells into which the wall is divided.
    value : (n,) residuals after the systematic effects are removed, m (ranges) or px (disparities).

    Returns
    -------
    FloatArray : (n,) standardised deviations; NaN for points in no cell or in cells with too few points for a plane.
    """
    inside = cells.cell >= 0
    cell = cells.cell[inside]
    offset = (residuals.wall_xy[inside] - cells.centre[cell]) / cells.side_m
    weight = 1 / residuals.sigma[inside]
    basis = np.stack([np.ones(len(cell)), offset[:, 0], offset[:, 1]], axis=1) * weight[:, None]
    y = value[inside] * weight

    def total(column: FloatArray) -> FloatArray:
        return np.bincount(cell, column, len(cells)).astype(np.float64)

    matrix = np.stack([np.stack([total(basis[:, i] * basis[:, j]) for j in range(3)], axis=-1) for i in range(3)], axis=-2)
    right = np.stack([total(basis[:, i] * y) for i in range(3)], axis=-1)
    inverse = np.linalg.pinv(matrix, rcond=1e-8, hermitian=True)
    fitted = np.einsum("ni,nij,nj->n", basis, inverse[cell], right[cell])
    left = 1 - np.einsum("ni,nij,nj->n", basis, inverse[cell], basis)
    z = np.full(len(residuals), np.nan)
    z[inside] = np.where(
        left > _LEAST_REMAINING_VARIANCE, (y - fitted) / np.sqrt(np.maximum(left, _LEAST_REMAINING_VARIANCE)), np.nan
    )
    return z


def variance_candidates(residuals: Residuals) -> list[VarianceCandidate]:
    """List the noise effects of the catalogue that can be fitted to residuals.

    An effect is left out if it needs a field that was not recorded, such as the intensity. Noise that neighbouring points share
    is also left out: effects are fitted to deviations within small squares of the wall, where it hardly shows.
    """
    found = []
    for effect in residuals.candidates:
        if effect.shows_in == ShowsIn.SPREAD and not effect.shared and effect.known(residuals.geometry):
            key, tried = effect.trials or ("", ())
            found += [_candidate(effect, residuals.geometry, {key: value}) for value in tried] or [
                _candidate(effect, residuals.geometry, {})
            ]
    return found


def _candidate(effect: type[Effect], geometry: Geometry, fixed: dict[str, float]) -> VarianceCandidate:
    """Return the variance candidate of an effect, with one column for each typical size.

    Extreme values are clipped, so that a few points cannot decide.
    """
    sizes = effect.typical_sizes()
    columns = np.stack([effect(**fixed, **{key: size}).variance(geometry) for key, size in sizes.items()], axis=1)
    columns = np.minimum(columns, np.quantile(columns, _HIGHEST_QUANTILE, axis=0))
    return VarianceCandidate(effect.tag(), columns, tuple(sizes.values()), tuple(sizes), len(sizes) + len(fixed), fixed)


def fit_variance_model(
    residuals: Residuals, cells: WallCells, value: FloatArray, random: KeyedRandom, excluded: frozenset[str] = frozenset()
) -> tuple[list[VarianceTerm], list[VarianceScore], str]:
    """Find at most two noise terms that explain why the residuals scatter more than the sensor model predicts.

    Parameters
    ----------
    residuals : residuals of n points with their predicted standard deviations.
    cells : small squares of the wall; deviations from a plane within each are used.
    value : (n,) residuals after the systematic effects are removed, m (ranges) or px (disparities).
    random : source of random numbers for the null distribution.
    excluded : names of effects that are not tried.

    Returns
    -------
    tuple : the noise terms; the scores of all candidates, best first; and a note on variance that no effect explains, or "".
    """
    candidates = [each for each in variance_candidates(residuals) if each.name not in excluded]
    if not candidates:
        return [], [], ""
    weighted, predicted = residuals, residuals.sigma**2 * _expected_mean_square(residuals, cells, random)
    for first_round in (True, False):
        # in the second round points have the weight of their fitted noise, as noisy points would shift the plane of their cell
        z = standardised_deviations(weighted, cells, value)
        if not np.isfinite(z).any():  # no cell has enough points for a plane and a deviation from it
            return [], [], ""
        used = np.isfinite(z) & (np.abs(z) < thresholds().points.outlier_sigmas * max(1.0, nmad(z, 0.0)))
        squares = (z * weighted.sigma)[used] ** 2 / predicted[used]
        shapes = [candidate.variance[used] / predicted[used, None] for candidate in candidates]
        singles = [_JointFit.fitted(squares, shapes, [number], candidates) for number in range(len(shapes))]
        best = max(singles, key=lambda fit: fit.score)
        if first_round:
            added = candidates[best.members[0]].variance @ best.theta[0]
            weighted = replace(residuals, sigma=np.sqrt(residuals.sigma**2 + added))
    excess = float(np.mean(best.added(shapes)))
    block = wall_block_numbers(residuals.wall_xy[used], cells.side_m)
    p_value = null_p_value(squares, [shape.sum(axis=1) for shape in shapes], block, random)
    tried = [VarianceScore(c.name, fit.gain, fit.score) for c, fit in zip(candidates, singles, strict=True)]
    tried = sorted(_best_variants(tried), key=lambda item: -item.score)
    by = thresholds().variance
    if best.gain < by.least_gain or p_value > thresholds().mean.significance or excess < by.least_excess:
        return [], tried, ""
    # for disparities `grid_noise` compares neighbours, because grid-correlated noise moves them alike too
    unshared = _unshared_share(residuals, value, used, best.added(shapes)) if residuals.sensor == "tls" else 1.0
    if unshared < by.least_unshared_share:
        return [], tried, _describe_shared_variance(excess, unshared, residuals.sigma)
    pairs = [
        _JointFit.fitted(squares, shapes, [first, second], candidates)
        for first, second in combinations(range(len(shapes)), 2)
        if candidates[first].name != candidates[second].name
    ]
    pair = max(pairs, key=lambda fit: fit.score, default=best)
    free = _best_binned_variance(squares, {name: v[used] for name, v in residuals.covariates.items()})
    # no form of a variance is exact, so a second effect or a free form must explain more than the inexact part of the first
    needed = max(by.least_gain, thresholds().mean.class_share * best.gain)
    agreement = _agreement(squares, best.added(shapes), pair.added(shapes), block)
    agreed = pair.score > best.score + needed and agreement > thresholds().edges.block_sigmas
    chosen = pair if agreed and all(float(theta.max()) > 0 for theta in pair.theta) else best
    ahead, agreement = free.score - chosen.score, _agreement(squares, chosen.added(shapes), free.added, block)
    free_fits_better = ahead > needed and agreement > thresholds().edges.least_block_sigmas
    empirical = free_fits_better and ahead > by.nonparametric_share * chosen.gain
    note = f"the noise also varies with {free.name}, which no effect of the catalogue explains" if free_fits_better else ""
    if empirical:
        chosen, note = best, ""
    tried = sorted([*tried, VarianceScore(free.name, free.gain, free.score, True)], key=lambda item: -item.score)
    margin = equivalence_margin(chosen.gain)
    found = []
    for place, number in enumerate(chosen.members):
        candidate, theta = candidates[number], chosen.theta[place]
        others = [fit for fit in (singles if len(chosen.members) == 1 else pairs) if _replaces_only(fit, chosen, number)]
        # two other effects that fit better, but by no more than the inexact part of one, may be the truth as well
        others += [pair] if chosen is best and number not in pair.members and pair.score > best.score + by.least_gain else []
        near = {candidates[n].name for fit in others if fit.score > chosen.score - margin for n in fit.members}
        alike = near - {candidates[each].name for each in chosen.members}
        parameters = candidate.parameters(theta)
        std = candidate.standard_deviations(theta, chosen.error[place])
        gain = chosen.gain - max(
            (fit.gain for fit in singles if fit.members != (number,) and fit.members[0] in chosen.members), default=0.0
        )
        name = f"variance by {free.name}" if empirical else candidate.name
        found.append(
            VarianceTerm(
                name,
                candidate.name,
                tuple(sorted(alike)),
                p_value,
                gain,
                parameters,
                std,
                empirical,
                candidate.variance @ theta,
            )
        )
    return found, tried, note


def _describe_shared_variance(excess: float, unshared: float, sigma: FloatArray) -> str:
    """Note on variance that neighbours share, which is no sensor noise. excess: added variance over the predicted one."""
    ratio, excess_mm = float(np.sqrt(1 + excess)), 1e3 * float(np.median(sigma)) * float(np.sqrt(excess))
    shared_percent = 100 * min(max(1 - unshared, 0.0), 1.0)
    return (
        f"the residuals have {ratio:.2g} times the predicted standard deviation ({excess_mm:.2g} mm more), and neighbours share "
        f"{shared_percent:.0f} % of the excess: an error of the reference, a change of the scene or wrong coordinates, not noise "
        "of the sensor"
    )


def _unshared_share(residuals: Residuals, value: FloatArray, used: BoolArray, added: FloatArray) -> float:
    """Return the share of an added variance that shows in the differences of neighbouring points.

    value: (n,) residuals after the systematic effects; used: (n,) points to use; added: (n,) added over predicted variance.
    """
    part = residuals.part(used)
    value, predicted = value[used], part.sigma**2
    other = cKDTree(part.wall_xy).query(part.wall_xy, k=2)[1][:, 1]
    variance = predicted + predicted[other] - 2 * part.reference_covariance_with(other)
    total = (added * predicted + (added * predicted)[other]) / variance
    weight = total / (1 + total) ** 2
    return float(np.sum(weight * ((value - value[other]) ** 2 / variance - 1)) / np.sum(weight * total))


@dataclass(frozen=True)
class NoiseRatio:
    """Observed over predicted standard deviation of residuals, to tell whether the sensor model's noise is right.

    It is computed from deviations from planes in small squares of the wall, without errors that vary slowly over the wall.

    Attributes
    ----------
    value : the ratio.
    clearly_below : whether the ratio is significantly below 1: most parts of the wall agree.
    """

    value: float
    clearly_below: bool

    @classmethod
    def of(cls, residuals: Residuals, cells: WallCells, value: FloatArray, random: KeyedRandom) -> NoiseRatio:
        """Compute the ratio of observed to predicted standard deviation of the residuals; outliers are clipped.

        Parameters
        ----------
        residuals : residuals of n points with their predicted standard deviations.
        cells : small squares of the wall; deviations from a plane within each are used.
        value : (n,) residuals after the systematic effects are removed, m (ranges) or px (disparities).
        random : source of random numbers, with which correlated noise is simulated.
        """
        z = standardised_deviations(residuals, cells, value)
        used = np.isfinite(z)
        if not used.any():
            return cls(1.0, False)
        squares = np.minimum(z[used] ** 2, _CLIP_SIGMAS**2) / _expected_mean_square(residuals, cells, random)
        means = np.bincount(
            np.unique(wall_block_numbers(residuals.wall_xy[used], cells.side_m), return_inverse=True)[1], squares - 1
        )
        below = float(means.sum()) < -thresholds().edges.block_sigmas * float(np.linalg.norm(means))
        return cls(float(np.sqrt(squares.mean())), below)

    @property
    def at_most_one(self) -> float:
        """Factor that corrects predicted noise that is too large: observed over predicted if clearly below 1, else 1.

        Such noise must be corrected in the sensor model itself, because effects only add noise.
        """
        return self.value if self.clearly_below and self.value < thresholds().variance.excess_noise_ratio else 1.0


def _expected_mean_square(residuals: Residuals, cells: WallCells, random: KeyedRandom) -> float:
    """Return the mean square of standardised deviations if the model is right, by simulation.

    Planes absorb more of correlated noise than of white noise.
    """
    field = residuals.correlated_noise.node_field(len(residuals))
    if not field.weights.shape[1]:
        return 1.0
    own = np.sqrt(np.maximum(residuals.sigma**2 - field.variance, _LEAST_WHITE_SHARE * residuals.sigma**2))
    root, draws = np.linalg.cholesky(field.covariance), random.child("share").generator()
    squares = []
    for _ in range(_EXPECTATION_DRAWS):
        shared = field.weights @ (root @ draws.standard_normal(len(root)))
        squares.append(np.nanmean(standardised_deviations(residuals, cells, shared + own * draws.standard_normal(len(own))) ** 2))
    return float(np.mean(squares))


def _best_variants(tried: list[VarianceScore]) -> list[VarianceScore]:
    """Return the best score of each noise effect; some effects were tried with several values of a parameter."""
    return list({item.name: item for item in sorted(tried, key=lambda item: item.score)}.values())


@dataclass(frozen=True)
class _JointFit:
    """Some candidates fitted together.

    members: numbers of the candidates; theta, error: coefficients of each and their standard deviations; gain: log-likelihood
    ratio; score: gain minus the number of parameters.
    """

    members: tuple[int, ...]
    theta: tuple[FloatArray, ...]
    error: tuple[FloatArray, ...]
    gain: float
    score: float

    @classmethod
    def fitted(
        cls, squares: FloatArray, shapes: list[FloatArray], members: list[int], candidates: list[VarianceCandidate]
    ) -> _JointFit:
        """Fit 1 + sum theta f to the squared deviations by Fisher scoring, theta >= 0."""
        columns = np.concatenate([shapes[number] for number in members], axis=1)
        scale = 1 / np.maximum(columns.mean(axis=0), 1e-300)
        columns = columns * scale
        theta = np.full(len(scale), max(float(np.mean(squares)) - 1, 1e-3) / len(scale))
        information = np.eye(len(scale))
        for _ in range(_FISHER_ROUNDS):
            total = 1 + columns @ theta
            slope = 0.5 * columns.T @ ((squares - total) / total**2)
            information = 0.5 * (columns / total[:, None] ** 2).T @ columns
            free = (theta > 0) | (slope > 0)
            step = np.zeros(len(theta))
            step[free] = np.linalg.lstsq(information[np.ix_(free, free)], slope[free], rcond=1e-10)[0]
            theta = np.maximum(theta + step, 0.0)
        gain = _log_likelihood_gain(squares, columns @ theta)
        error = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), 0.0))
        ends = np.cumsum([shapes[number].shape[1] for number in members])[:-1]
        score = gain - sum(candidates[number].cost for number in members)
        return cls(tuple(members), tuple(np.split(theta * scale, ends)), tuple(np.split(error * scale, ends)), gain, score)

    def added(self, shapes: list[FloatArray]) -> FloatArray:
        """(n,) added variance over the predicted one."""
        return np.asarray(sum(shapes[number] @ theta for theta, number in zip(self.theta, self.members, strict=True)))


def _replaces_only(fit: _JointFit, chosen: _JointFit, number: int) -> bool:
    """Whether a fit differs from the chosen one in one candidate only."""
    return number not in fit.members and set(chosen.members) - {number} <= set(fit.members)


def _agreement(squares: FloatArray, first: FloatArray, second: FloatArray, block: NDArray[np.int64]) -> float:
    """Return how far wall blocks agree that the second variance fits better, so that the gain is not due to a few blocks.

    It is the log-likelihood ratio over the root sum of squares of the wall blocks' contributions.
    """
    terms = 0.5 * (squares * (second - first) / ((1 + first) * (1 + second)) + np.log1p(first) - np.log1p(second))
    sums = np.bincount(np.unique(block, return_inverse=True)[1], terms)
    return float(sums.sum()) / max(float(np.linalg.norm(sums)), 1e-300)


def _log_likelihood_gain(squares: FloatArray, added: FloatArray) -> float:
    """Log-likelihood ratio of an added variance (n,)."""
    return float(0.5 * np.sum(squares * added / (1 + added) - np.log1p(added)))


def _best_binned_variance(squares: FloatArray, covariates: Mapping[str, FloatArray]) -> _BinnedVariance:
    """Return the covariate along which a variance free in each bin explains most.

    Tails that are heavier than those of a normal distribution let the variances of bins differ more by chance. What the bins
    explain beside their common mean is divided by that factor, which follows from the kurtosis.
    """
    mean = float(np.mean(squares))
    tails = max(0.5 * (float(np.mean(squares**2)) / mean**2 - 1), 1.0)
    common = 0.5 * len(squares) * (mean - 1 - np.log(mean))
    best = _BinnedVariance("", -np.inf, -np.inf, np.zeros(len(squares)))
    for name, group in _bins(covariates):
        count = np.maximum(np.bincount(group), 1)
        variance = np.maximum(np.bincount(group, squares) / count, 1e-9)
        gain = float(common + 0.5 * np.sum(count * np.log(mean / variance)) / tails)
        if gain - len(count) > best.score:
            best = _BinnedVariance(name, gain, gain - len(count), (variance - 1)[group])
    return best


def _bins(covariates: Mapping[str, FloatArray]) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Yield (n,) bin numbers: equally filled bins of each covariate; scan lines, image rows and columns, and cycles of them."""
    for name, values in covariates.items():
        if name not in ("edge_step", "line"):
            yield name, np.searchsorted(np.quantile(values, np.linspace(0, 1, _BINS + 1)[1:-1]), values)
        if name in ("line", "image_x", "image_y"):
            lines, group = np.unique(np.round(values, _LINE_DIGITS), return_inverse=True)
            if 1 < len(lines) < len(values) / _FEWEST_IN_LINE:
                yield name, group
                number = np.rint((values - values.min()) / np.diff(lines).min()).astype(np.int64)
                yield from ((name, number % cycle) for cycle in range(2, _LONGEST_CYCLE + 1))
