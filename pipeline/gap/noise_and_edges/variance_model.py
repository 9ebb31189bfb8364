"""Fit the variance model: which noise terms explain the squared deviations within cells, by the Gaussian likelihood.

sigma_i^2 = predicted variance + sum_k theta_k f_k(i), theta_k >= 0, for candidate terms f_k of the catalogue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.change.robust import nmad
from pipeline.gap.noise_and_edges.sign_flips import null_p_value
from pipeline.gap.noise_and_edges.variance_fit import VarianceCandidate, VarianceFit, best_binned_variance
from pipeline.gap.residuals.residuals import BoolArray, Geometry, Residuals
from pipeline.gap.residuals.wall_blocks import WallCells, agreement
from pipeline.gap.thresholds import equivalence_margin, thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn

_LEAST_REMAINING_VARIANCE = 0.3
"""Least share of a point's variance that the plane of its cell must leave."""
_EXPECTATION_DRAWS = 10
"""Number of simulations of correlated noise."""
_CLIP_SIGMAS = 12.0
"""Standard deviations at which outliers are clipped."""
_HIGHEST_QUANTILE = 0.999
"""Quantile of a candidate's variance above which it is clipped."""


@dataclass(frozen=True)
class VarianceTerm:
    """A noise term that was found: it explains variance of the residuals that the sensor model does not predict.

    Attributes
    ----------
    effect : name of the effect of the catalogue that represents the term in a sensor model.
    indistinguishable : names of other effects that would explain the variance as well.
    p_value : p-value from the simulated null distribution.
    gain : log-likelihood ratio of the models with and without it.
    parameters, std : values of the effect's parameters and their standard deviations, by parameter name.
    empirical : true if no effect of the catalogue fits well, so that a variance fitted freely to a covariate is reported.
    variance : (n,) variance that it adds at each point, squared unit of the observable (m² or px²).
    """

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
class VarianceScore:
    """How well one noise term explains the squared residuals.

    Attributes
    ----------
    name : name of the effect; for a variance fitted freely to a covariate (empirical term), that covariate.
    gain, score : log-likelihood ratio of the models with and without the term, and the same minus the number of parameters.
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
            fixed = [{key: value} for value in tried] or [{}]
            found += [_candidate(effect, residuals.geometry, each) for each in fixed]
    return found


def _candidate(effect: type[Effect], geometry: Geometry, fixed: dict[str, float]) -> VarianceCandidate:
    """Return the variance candidate of an effect, with one column for each typical size.

    Extreme values are clipped, so that a few points cannot decide.
    """
    sizes = effect.typical_sizes()
    columns = np.stack([effect(**fixed, **{key: size}).variance(geometry) for key, size in sizes.items()], axis=1)
    columns = np.minimum(columns, np.quantile(columns, _HIGHEST_QUANTILE, axis=0))
    return VarianceCandidate(effect.tag(), columns, sizes, fixed)


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
    tuple : the noise terms; the scores of all candidates, best first; and a note on variance that no effect explains, or "". A
        term is marked empirical if a variance free in bins of a covariate fits better by more than the share
        `variance.nonparametric_share`, or if it fits clearly better and the wall blocks agree by `edges.block_sigmas`.
    """
    candidates = [each for each in variance_candidates(residuals) if each.name not in excluded]
    seen = _SquaredDeviations.of(residuals, cells, value, candidates, random) if candidates else None
    if seen is None:
        return [], [], ""
    by = thresholds().variance
    edges = thresholds().edges
    best, tried = seen.best, seen.scores()
    added = best.added(seen.shapes)
    p_value = null_p_value(seen.squares, [shape.sum(axis=1) for shape in seen.shapes], seen.block, random)
    if best.gain < by.least_gain or p_value > thresholds().mean.significance or added.mean() < by.least_excess:
        return [], tried, ""
    # for disparities `grid_noise` compares neighbours, because grid-correlated noise moves them alike too
    unshared = _unshared_share(residuals, value, seen.used, added) if residuals.sensor == "tls" else 1.0
    if unshared < by.least_unshared_share:
        return [], tried, _describe_shared_variance(float(added.mean()), unshared, residuals.sigma)
    pair = seen.best_pair
    added_by_pair = pair.added(seen.shapes)
    better = seen.is_clearly_better(pair.score - best.score, added, added_by_pair, edges.block_sigmas)
    chosen = pair if better and all(float(theta.max()) > 0 for theta in pair.theta) else best
    added = added_by_pair if chosen is pair else added
    free = best_binned_variance(seen.squares, {name: each[seen.used] for name, each in residuals.covariates.items()})
    tried = sorted([*tried, VarianceScore(free.name, free.gain, free.score, True)], key=lambda item: -item.score)
    lead = free.score - chosen.score
    if not seen.is_clearly_better(lead, added, free.added, edges.least_block_sigmas):
        return seen.terms(chosen, p_value), tried, ""
    blocks_agree_clearly = seen.is_clearly_better(lead, added, free.added, edges.block_sigmas)
    empirical = blocks_agree_clearly or lead > by.nonparametric_share * chosen.gain
    named = [replace(each, empirical=empirical) for each in seen.terms(best if empirical else chosen, p_value)]
    varies = "varies" if empirical else "also varies"
    return named, tried, f"the noise {varies} with {free.name}, which no effect of the catalogue explains"


@dataclass(frozen=True)
class _SquaredDeviations:
    """Squared deviations of residuals within small squares of the wall, and what noise effects would add to them.

    candidates: the noise effects; used: (n,) points with a deviation that is no outlier, m of them; squares: (m,) squared
    deviations over the predicted ones; shapes: for each effect, (m, k) variance that its parameters add at their typical sizes,
    over the predicted variance; block: (m,) wall block of each point; singles: the fit of each effect alone.
    """

    candidates: list[VarianceCandidate]
    used: BoolArray
    squares: FloatArray
    shapes: list[FloatArray]
    block: NDArray[np.int64]
    singles: list[VarianceFit]

    @classmethod
    def of(
        cls, residuals: Residuals, cells: WallCells, value: FloatArray, candidates: list[VarianceCandidate], random: KeyedRandom
    ) -> _SquaredDeviations | None:
        """Compute the deviations, and fit each effect. None if no cell has enough points for a plane and a deviation from it.

        This is done twice: the second time, points have the weight of their fitted noise in the planes of their cells, which
        noisy points would shift.
        """
        predicted = residuals.sigma**2 * _expected_mean_square(residuals, cells, random)

        def deviations(weighted: Residuals) -> _SquaredDeviations | None:
            z = standardised_deviations(weighted, cells, value)
            if not np.isfinite(z).any():
                return None
            used = np.isfinite(z) & (np.abs(z) < thresholds().points.outlier_sigmas * max(1.0, nmad(z, 0.0)))
            squares = (z * weighted.sigma)[used] ** 2 / predicted[used]
            shapes = [candidate.variance[used] / predicted[used, None] for candidate in candidates]
            singles = [VarianceFit.fitted(squares, shapes, [number], candidates) for number in range(len(shapes))]
            return cls(candidates, used, squares, shapes, cells.blocks.numbers(residuals.wall_xy[used]), singles)

        first = deviations(residuals)
        if first is None:
            return None
        added = candidates[first.best.members[0]].variance @ first.best.theta[0]
        return deviations(replace(residuals, sigma=np.sqrt(residuals.sigma**2 + added)))

    @property
    def best(self) -> VarianceFit:
        """The best fit of one effect."""
        return max(self.singles, key=lambda fit: fit.score)

    @cached_property
    def pairs(self) -> list[VarianceFit]:
        """Fits of two different effects together."""
        return [
            VarianceFit.fitted(self.squares, self.shapes, [first, second], self.candidates)
            for first, second in combinations(range(len(self.shapes)), 2)
            if self.candidates[first].name != self.candidates[second].name
        ]

    @property
    def best_pair(self) -> VarianceFit:
        """The best fit of two effects; that of one if there is no other."""
        return max(self.pairs, key=lambda fit: fit.score, default=self.best)

    def scores(self) -> list[VarianceScore]:
        """Scores of the effects, best first. Of an effect that was tried with several values of a parameter, the best counts."""
        tried = [VarianceScore(each.name, fit.gain, fit.score) for each, fit in zip(self.candidates, self.singles, strict=True)]
        best = {item.name: item for item in sorted(tried, key=lambda item: item.score)}
        return sorted(best.values(), key=lambda item: -item.score)

    def is_clearly_better(self, lead: float, first: FloatArray, second: FloatArray, least_sigmas: float) -> bool:
        """Tell whether a second variance fits clearly better than a first, and the wall blocks agree by at least `least_sigmas`.

        lead: score of the second minus that of the first. It must exceed `variance.least_gain`, and the share `mean.class_share`
        of the best effect's gain, because the form of an effect is never exact. first, second: (m,) variances that they add at
        the points used, over the predicted one.
        """
        terms = 0.5 * (self.squares * (second - first) / ((1 + first) * (1 + second)) + np.log1p(first) - np.log1p(second))
        sums = np.bincount(np.unique(self.block, return_inverse=True)[1], terms)
        least = max(thresholds().variance.least_gain, thresholds().mean.class_share * self.best.gain)
        return lead > least and agreement(sums) > least_sigmas

    def terms(self, chosen: VarianceFit, p_value: float) -> list[VarianceTerm]:
        """Describe each effect of a fit, with those that cannot be told from it."""
        found, pair, single = [], self.best_pair, len(chosen.members) == 1
        tried, least = self.singles if single else self.pairs, chosen.score - equivalence_margin(chosen.gain)
        for number, theta, error in zip(chosen.members, chosen.theta, chosen.error, strict=True):
            candidate = self.candidates[number]
            kept = {*chosen.members} - {number}
            others = [fit for fit in tried if number not in fit.members and kept <= {*fit.members}]
            # two other effects that fit better, but by no more than the inexact part of one, may be the truth as well
            also = single and number not in pair.members
            others += [pair] if also and pair.score > chosen.score + thresholds().variance.least_gain else []
            near = {self.candidates[n].name for fit in others if fit.score > least for n in fit.members}
            alone = (fit.gain for fit in self.singles if fit.members != (number,) and fit.members[0] in chosen.members)
            found.append(
                VarianceTerm(
                    effect=candidate.name,
                    indistinguishable=tuple(sorted(near - {self.candidates[each].name for each in chosen.members})),
                    p_value=p_value,
                    gain=chosen.gain - max(alone, default=0.0),
                    parameters=candidate.parameters(theta),
                    std=candidate.standard_deviations(theta, error),
                    empirical=False,
                    variance=candidate.variance @ theta,
                )
            )
        return found


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

    Errors that vary slowly over the wall do not count, as in `standardised_deviations`.

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
        means = np.bincount(np.unique(cells.blocks.numbers(residuals.wall_xy[used]), return_inverse=True)[1], squares - 1)
        return cls(float(np.sqrt(squares.mean())), agreement(means) < -thresholds().edges.block_sigmas)

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
    own = np.sqrt(field.white_variance(residuals.sigma))
    root, draws = np.linalg.cholesky(field.covariance), random.child("share").generator()
    squares = []
    for _ in range(_EXPECTATION_DRAWS):
        shared = field.weights @ (root @ draws.standard_normal(len(root)))
        squares.append(np.nanmean(standardised_deviations(residuals, cells, shared + own * draws.standard_normal(len(own))) ** 2))
    return float(np.mean(squares))
