"""Validate each effect on wall blocks that no fit has used: the Gaussian log score with the effect minus the score without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.within_cell_noise import inverse_from_cholesky
from pipeline.gap.naming.named_effects import NamedEffect, aligned_with
from pipeline.gap.residuals.alignment import fit_pose
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray
from sensors.effects.base import ShowsIn

_POINTS_PER_PATCH = 30.0
_LEAST_WHITE_SHARE = 0.02
"""Least share of a point's variance that counts as white noise, where the model has correlated noise only."""


@dataclass(frozen=True)
class ValidatedEffects:
    """Sensor errors that the fit found, sorted by whether they improve predictions on parts of the wall that no fit used.

    Attributes
    ----------
    named : effects that improve the predictions; the gain of each is its log-likelihood ratio on these parts.
    failed : effects that do not improve them.
    weak : effects that improve them, but by less than an effect must to be reported by name.
    """

    named: list[NamedEffect]
    failed: list[NamedEffect]
    weak: list[NamedEffect]


def validate_effects(
    measurement: Measurement, residuals: Residuals, named: list[NamedEffect], training: BoolArray, reference_sigma: float
) -> ValidatedEffects:
    """Test whether each named effect (sensor error) improves the likelihood of parts of the wall that no fit used.

    The model with all effects is compared with the model without the tested one. Two systematic effects may only compensate each
    other, and then each seems to be needed. Therefore all systematic effects are first tested together. If they fail, the one
    with the smallest log-likelihood ratio is removed, an empirical term before any other, and the test is repeated with the rest.

    Parameters
    ----------
    measurement : the measured points, with the sensor at its aligned pose.
    residuals : its residuals of n points.
    named : effects to validate.
    training : (n,) true for points from which the pose is estimated; the other points, the validation points, are scored.
    reference_sigma : standard deviation of the error of the reference surface, in the unit of the observable (m or px).

    Returns
    -------
    ValidatedEffects : accepted effects; failed ones, which do not improve the likelihood; and weak ones, which improve it, but
        too little to be named beside others (`variance.least_gain`), or whose size is within its uncertainty of zero.
    """
    scorable = [item for item in named if item.effect.scored()]
    if not scorable or (~training).sum() < 100:
        return ValidatedEffects(named, [], [])
    with_all = _registered_residuals(measurement, named, residuals, training)
    shared = float(np.mean(residuals.with_sigma_of_means.sigma**2 - residuals.sigma**2)) / _POINTS_PER_PATCH
    patch_sigma = float(np.sqrt(reference_sigma**2 + shared))

    def gain(out: list[NamedEffect]) -> float:
        """Validation gain of some effects."""
        without = _registered_residuals(measurement, [each for each in named if each not in out], residuals, training)
        known = np.isfinite(with_all.value) & np.isfinite(without.value)
        return _log_score_gain(with_all, without, known & ~training, residuals.wall_xy, patch_sigma)

    found = {item.name: gain([item]) for item in scorable}
    systematic = [item for item in scorable if not item.adds_variance]
    if len(systematic) > 1 and gain(systematic) <= 0:
        out = min(systematic, key=lambda item: (item.kind != "empirical", found[item.name]))
        rest = [each for each in named if each is not out]
        left = validate_effects(measurement, residuals, rest, training, reference_sigma)
        return ValidatedEffects(left.named, [out, *left.failed], left.weak)
    failed = [item for item in scorable if found[item.name] <= item.effect.held_out_gain]
    measured = [replace(item, gain=found[item.name]) if item.name in found else item for item in named if item not in failed]
    weak = [item for item in measured if _is_weak(item)] if len(measured) > 1 else []
    return ValidatedEffects([item for item in measured if item not in weak], failed, weak)


def _is_weak(item: NamedEffect) -> bool:
    """Whether an effect beside others gains too little to be named, or is consistent with zero."""
    least = thresholds().variance.least_gain
    return item.kind == "physical" and item.effect.scored() and (item.gain <= least or _is_consistent_with_zero(item))


def describe_weakness(item: NamedEffect) -> str:
    """Say in the report why an effect (sensor error) is mentioned but not named, although it improves the predictions.

    item: an effect whose size is consistent with zero, or whose log-likelihood ratio on validation blocks is too small.
    """
    if _is_consistent_with_zero(item):
        return "its value is within its uncertainty of zero"
    return f"it gains only {item.gain:.1f} in log-likelihood on validation blocks"


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

    def log_score(self, rows: NDArray[np.int64], patch: NDArray[np.int64], reference_sigma: float) -> float:
        """Return the Gaussian log score of some rows, without its constant.

        Each patch of the wall shares one error of the reference, and neighbours share grid-correlated noise. The covariance is
        inverted by Woodbury's identity and the determinant lemma, first for the errors of the patches and then for the grid.

        Parameters
        ----------
        rows : (k,) rows to score.
        patch : (k,) number of the patch in which each row lies.
        reference_sigma : standard deviation of the reference error of a patch, in the observable's unit.
        """
        value, sigma = self.value[rows], self.sigma[rows]
        field = self.shared.part(rows).node_field(len(rows))
        nodes, own = field.weights, np.maximum(sigma**2 - field.variance, _LEAST_WHITE_SHARE * sigma**2)
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
            prior = cholesky(field.covariance, lower=True)
            root = cholesky(matrix + inverse_from_cholesky(prior), lower=True)
            right = nodes.T @ weighed - node_sums.T @ (shrinkage * sums)
            square -= np.sum(solve_triangular(root, right, lower=True) ** 2)
            size += 2 * np.sum(np.log(np.diag(root)) + np.log(np.diag(prior)))
        return float(-0.5 * (square + size))


def _log_score_gain(
    with_all: _RegisteredResiduals, without: _RegisteredResiduals, rows: BoolArray, at: FloatArray, sigma: float
) -> float:
    """Return the log score with an effect minus that without, over some rows (n,). Outliers of both models are left out.

    at: (n, 2) places on the wall, m; sigma: standard deviation of the reference error.
    """
    chosen = np.flatnonzero(rows & (_inliers(with_all) | _inliers(without)))
    patch = wall_blocks_by_points(at[chosen], _POINTS_PER_PATCH)
    return with_all.log_score(chosen, patch, sigma) - without.log_score(chosen, patch, sigma)


def _inliers(found: _RegisteredResiduals) -> BoolArray:
    """(n,) residuals that are no outliers. Debris or a fallen block would move the mean of a patch."""
    z = found.value / found.sigma
    return np.asarray(np.abs(z) < thresholds().points.outlier_sigmas * max(nmad(z), 1.0))


def _registered_residuals(
    measurement: Measurement, named: list[NamedEffect], residuals: Residuals, training: BoolArray
) -> _RegisteredResiduals:
    """Return the residuals of all points with some effects in the model.

    The pose is estimated from the training points. Residuals are NaN where the surface is not smooth.
    """
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
