"""Validate each effect on wall blocks that no fit has used: the Gaussian log score with the effect minus the score without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.naming.effect_selection import SelectionResult
from pipeline.gap.naming.named_effects import NamedEffect, aligned_with
from pipeline.gap.noise_and_edges.sign_flips import DRAWS
from pipeline.gap.residuals.alignment import fit_pose
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise, NodeField
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.wall_blocks import BlockGrid, wall_blocks_by_points
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import ShowsIn

_POINTS_PER_PATCH = 30.0
_ROUNDING = 1e-9
"""Relative rounding error of a sum."""
_FEWEST_POINTS = 100
"""Fewest validation points for effects to be scored."""


@dataclass(frozen=True)
class ValidatedEffects:
    """Sensor errors that the fit found, sorted by whether they improve predictions on parts of the wall that no fit used.

    Attributes
    ----------
    named : effects that improve the predictions; the gain of each is its log-likelihood ratio on these parts.
    failed : effects that do not improve them.
    weak : effects that improve them, but too little to be named beside others: by no more than `variance.least_gain`, in too few
        wall blocks (`verdict.block_p`), with a size within its uncertainty of zero, or, for an empirical term, by less than the
        share `mean.class_share` of what the strongest effect gains.
    """

    named: list[NamedEffect]
    failed: list[NamedEffect]
    weak: list[NamedEffect]

    def with_needed(self, selection: SelectionResult) -> ValidatedEffects:
        """Return the same effects, with the weak systematic ones of the catalogue named if only they explain a misfit.

        Without them the residuals must clearly disagree with the model (`verdict.rejection_p`), and with them no longer.

        selection: the selection that found the effects.
        """
        needed = [item for item in self.weak if item.name in selection.systematic and item.kind == "physical"]
        if not needed:
            return self
        with_them = [*self.named, *needed]
        before, after = selection.p_value_given(self.named), selection.p_value_given(with_them)
        if before is None or after is None or not before <= thresholds().verdict.rejection_p < after:
            return self
        named = sorted(with_them, key=lambda item: -item.gain)
        return ValidatedEffects(named, self.failed, [item for item in self.weak if item not in needed])


def validate_effects(
    measurement: Measurement,
    residuals: Residuals,
    named: list[NamedEffect],
    training: BoolArray,
    reference_sigma: float,
    blocks: BlockGrid,
) -> ValidatedEffects:
    """Test whether each named effect (sensor error) improves the likelihood of parts of the wall that no fit used.

    The model with all effects is compared with the model without the tested one. Systematic effects may only compensate each
    other, and then each seems to be needed. Therefore groups of them are tested together first: all, all but the strongest ones,
    and each two. If a group fails, its effect with the smallest log-likelihood ratio is removed, an empirical term before any
    other, and the test is repeated with the rest.

    Parameters
    ----------
    measurement : the measured points, with the sensor at its aligned pose.
    residuals : its residuals of n points.
    named : effects to validate.
    training : (n,) true for points from which the pose is estimated; the other points, the validation points, are scored.
    reference_sigma : standard deviation of the error of the reference surface, in the unit of the observable (m or px).
    blocks : the large squares of the wall (wall blocks), each of which is used as a whole for fits or for validation.
    """
    shared = float(np.mean(residuals.with_sigma_of_means.sigma**2 - residuals.sigma**2)) / _POINTS_PER_PATCH
    patch_sigma = float(np.sqrt(reference_sigma**2 + shared))
    block = blocks.numbers(residuals.wall_xy)

    @cache
    def registered(kept: frozenset[int]) -> _RegisteredResiduals:
        return _registered_residuals(measurement, [each for each in named if id(each) in kept], residuals, training)

    def gains(tested: Sequence[NamedEffect], among: Sequence[NamedEffect]) -> FloatArray:
        """Validation gain in each wall block of effects among others, which stay in the model."""
        every, out = frozenset(map(id, among)), frozenset(map(id, tested))  # by object: two empirical terms may share a name
        with_all, without = registered(every), registered(every - out)
        known = np.isfinite(with_all.value) & np.isfinite(without.value)
        return _log_score_gains(with_all, without, known & ~training, residuals.wall_xy, block, patch_sigma)

    return _sorted_by_gain(named, gains) if (~training).sum() >= _FEWEST_POINTS else ValidatedEffects(named, [], [])


def _sorted_by_gain(
    named: list[NamedEffect], gains: Callable[[Sequence[NamedEffect], Sequence[NamedEffect]], FloatArray]
) -> ValidatedEffects:
    """Sort effects by their gains. gains: function that returns the gain in each wall block of effects among others."""
    scorable = [item for item in named if item.effect.scored()]
    found = {id(item): gains([item], named) for item in scorable}
    total = {number: float(each.sum()) for number, each in found.items()}
    strongest_first = sorted((item for item in scorable if not item.adds_variance), key=lambda item: -total[id(item)])
    for group in _groups(strongest_first):
        if gains(group, named).sum() <= 0:
            out = min(group, key=lambda item: (item.kind != "empirical", total[id(item)]))
            left = _sorted_by_gain([each for each in named if each is not out], gains)
            return ValidatedEffects(left.named, [out, *left.failed], left.weak)
    failed = [item for item in scorable if total[id(item)] <= item.effect.held_out_gain]
    kept = [item for item in named if item not in failed]
    measured = [replace(item, gain=total.get(id(item), item.gain)) for item in kept]
    gains_in_blocks = [found.get(id(item)) for item in kept]
    of_form = [item for item in measured if item.kind == "physical" and item.effect.shows_in in (ShowsIn.MEAN, ShowsIn.EDGES)]
    most = max((item.gain for item in of_form), default=0.0)
    weak = [each for each, own in zip(measured, gains_in_blocks, strict=True) if len(kept) > 1 and _is_weak(each, own, most)]
    return ValidatedEffects([item for item in measured if item not in weak], failed, weak)


def _groups(effects: Sequence[NamedEffect]) -> list[tuple[NamedEffect, ...]]:
    """Groups of effects (the strongest first) that may compensate each other: all but the strongest ones, and pairs."""
    nested = [tuple(effects[start:]) for start in range(len(effects) - 2)]
    return [*nested, *combinations(effects, 2)]


def _is_weak(item: NamedEffect, gains: FloatArray | None, most: float) -> bool:
    """Whether an effect is weak beside others (see `ValidatedEffects`). most: what the strongest effect gains.

    An empirical term may describe no more than the inexact part of that effect. Noise and lost returns do not count as the
    strongest effect: they move no point, so their form cannot be mistaken for a curve.
    """
    if gains is None:
        return False
    if item.kind != "physical":
        return not item.adds_variance and item.gain < thresholds().mean.class_share * most
    return item.gain <= thresholds().variance.least_gain or _is_consistent_with_zero(item) or not blocks_agree(gains)


def blocks_agree(gains: FloatArray) -> bool:
    """Whether wall blocks agree that an effect (sensor error) improves predictions, whatever the model leaves unexplained.

    The test flips the signs of the blocks' gains at random. If the effect did not help, gains and losses would be equally
    likely in each block. Then a sum as large as that of the observed gains would be rare: its probability must be at most
    `verdict.block_p`. With so few blocks that this cannot be reached, all must gain.

    gains: (b,) log-likelihood ratio with and without the effect in each of b blocks that no fit used.
    """
    signs = KeyedRandom(1, ("block gains",)).generator().choice([-1.0, 1.0], size=(DRAWS, len(gains)))
    reached = int(np.sum(signs @ gains >= gains.sum() * (1 - _ROUNDING)))
    return bool((gains > 0).all()) or (1 + reached) / (1 + DRAWS) <= thresholds().verdict.block_p


def describe_weakness(item: NamedEffect) -> str:
    """Say in the report why a weak effect (see `ValidatedEffects`) is not named although it improves the predictions."""
    gain = f"{item.gain:.1f} in log-likelihood on validation blocks"
    if item.kind != "physical":
        share = f"{100 * thresholds().mean.class_share:g} %"
        most = f"less than {share} of what the strongest effect gains"
        return f"it gains only {gain}, {most}; the form of that effect may be wrong by as much"
    if _is_consistent_with_zero(item):
        return "its value is within its uncertainty of zero"
    if item.gain <= thresholds().variance.least_gain:
        return f"it gains only {gain}"
    return f"it gains {gain}, but these blocks do not agree: their gains could be chance"


def _is_consistent_with_zero(item: NamedEffect) -> bool:
    """Whether the only parameter of a systematic effect is within its uncertainty of zero."""
    values = [(item.entry[key], std) for key, std in item.std.items() if std]
    if item.effect.shows_in != ShowsIn.MEAN or len(values) != 1:
        return False
    ((value, std),) = values
    return abs(value) < thresholds().verdict.gap_sigmas * std


@dataclass(frozen=True)
class _RegisteredResiduals:
    """Residuals (n,) against some model after the pose fit, their predicted standard deviations, and their correlated noise."""

    value: FloatArray
    sigma: FloatArray
    shared: GridCorrelatedNoise

    def log_score(self, rows: NDArray[np.int64], field: NodeField, patch: NDArray[np.int64], reference_sigma: float) -> float:
        """Return the Gaussian log score of some rows, without its constant.

        Each patch of the wall shares one error of the reference, and neighbours share grid-correlated noise. The covariance is
        inverted by Woodbury's identity and the determinant lemma, first for the errors of the patches and then for the grid.

        Parameters
        ----------
        rows : (k,) rows to score.
        field : the grid-correlated noise at these rows.
        patch : (k,) number of the patch in which each row lies.
        reference_sigma : standard deviation of the reference error of a patch, in the observable's unit.
        """
        value, sigma = self.value[rows], self.sigma[rows]
        nodes, own = field.weights, field.white_variance(sigma)
        total = np.bincount(patch, 1 / own)
        mean = np.bincount(patch, value / own) / total
        limit = thresholds().points.outlier_sigmas * sigma
        left = np.clip(value - mean[patch], -limit, limit)
        shrinkage = 1 / (1 / reference_sigma**2 + total) if reference_sigma else np.zeros(len(total))
        gathered = csr_array((1 / own, (patch, np.arange(len(rows)))))
        weighed = (left + mean[patch]) / own
        sums, node_sums = total * mean, gathered @ nodes
        square = np.sum((left + mean[patch]) * weighed) - np.sum(shrinkage * sums**2)
        size = np.sum(np.log(own)) - np.sum(np.log1p(-shrinkage * total))
        if nodes.shape[1]:
            matrix = (nodes.T @ nodes.multiply(1 / own[:, None]) - node_sums.T @ node_sums.multiply(shrinkage[:, None])).toarray()
            root = cholesky(matrix + field.precision, lower=True)
            right = nodes.T @ weighed - node_sums.T @ (shrinkage * sums)
            square -= np.sum(solve_triangular(root, right, lower=True) ** 2)
            size += 2 * np.sum(np.log(np.diag(root)) + np.log(np.diag(field.root)))
        return float(-0.5 * (square + size))


def _log_score_gains(
    with_all: _RegisteredResiduals,
    without: _RegisteredResiduals,
    rows: BoolArray,
    at: FloatArray,
    block: NDArray[np.int64],
    sigma: float,
) -> FloatArray:
    """(b,) log score with an effect minus that without, in each wall block. Outliers of both models are left out.

    Empty if no point can be scored: with large effects, rays may miss the wall, or all may hit edges.
    rows: (n,) points to score; at: (n, 2) places on the wall, m; block: (n,) wall block of each point; sigma: standard
    deviation of the reference error.
    """
    chosen = np.flatnonzero(rows & (_inliers(with_all) | _inliers(without)))
    if not len(chosen):
        return np.zeros(0)
    patch = wall_blocks_by_points(at[chosen], _POINTS_PER_PATCH)
    noises = {each.effects: each for each in (with_all.shared, without.shared)}  # one if the effect is no grid-correlated noise
    found = []
    for number in np.unique(block[chosen]):
        inside = block[chosen] == number
        own_patch, own_rows = np.unique(patch[inside], return_inverse=True)[1], chosen[inside]
        fields = {effects: noise.part(own_rows).node_field(len(own_rows)) for effects, noise in noises.items()}
        after, before = (each.log_score(own_rows, fields[each.shared.effects], own_patch, sigma) for each in (with_all, without))
        found.append(after - before)
    return np.array(found)


def _inliers(found: _RegisteredResiduals) -> BoolArray:
    """(n,) residuals that are no outliers. Debris or a fallen block would move the mean of a patch."""
    z = found.value / found.sigma
    return np.asarray(np.abs(z) < thresholds().points.outlier_sigmas * max(nmad(z), 1.0))


def _registered_residuals(
    measurement: Measurement, named: list[NamedEffect], residuals: Residuals, training: BoolArray
) -> _RegisteredResiduals:
    """Residuals of all points with effects in the model, the pose from the training points; NaN where it is not smooth."""
    found = aligned_with(measurement, named, residuals.index[training]).residuals
    count = len(measurement.cloud.points)
    place = np.full(count, -1)
    place[found.index[found.usable]] = np.flatnonzero(found.usable)  # points at edges under this model are not used
    rows = place[residuals.index]
    known = rows >= 0
    value, sigma = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    pose = fit_pose(found, rows[training & known])
    value[known], sigma[known] = (found.value - found.pose_jacobian @ pose)[rows[known]], found.sigma[rows[known]]
    return _RegisteredResiduals(value, sigma, found.correlated_noise.part(rows))
