"""What each effect is worth on blocks that no step of naming has used: the Gaussian log score with it less that without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.mean.within_noise import inverse_of
from pipeline.gap.naming.named_effects import NamedEffect, aligned_with
from pipeline.gap.residuals.cells import patches
from pipeline.gap.residuals.registration import pose_of
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.shared_noise import SharedNoise
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray
from sensors.effects.base import ShowsIn

_POINTS_PER_PATCH = 30.0
_LEAST_WHITE_SHARE = 0.02
"""Share of a point's variance that counts as its own where a model says there is none."""


@dataclass(frozen=True)
class ValidatedEffects:
    """Effects with their held-out gains, those that failed, and those that are too weak beside others to be committed to."""

    named: list[NamedEffect]
    failed: list[NamedEffect]
    weak: list[NamedEffect]


def validate_effects(
    measurement: Measurement, residuals: Residuals, named: list[NamedEffect], trained: BoolArray, reference_sigma: float
) -> ValidatedEffects:
    """Score each effect with all others in the model. trained: (n,) points by which to register; the others are scored.

    Effects on the mean may only make up for each other, and then each seems to be needed. So what all of them gain together is
    tested first; where that fails, the one that matters least goes, an empirical term before any other.
    """
    scored = [item for item in named if item.effect.scored()]
    if not scored or (~trained).sum() < 100:
        return ValidatedEffects(named, [], [])
    whole = _registered_residuals(measurement, named, residuals, trained)
    shared = float(np.mean(residuals.averaged.sigma**2 - residuals.sigma**2)) / _POINTS_PER_PATCH
    patch_sigma = float(np.sqrt(reference_sigma**2 + shared))

    def gains(out: list[NamedEffect]) -> tuple[float, float]:
        """Of some effects on the points that are scored, and what those that were trained let expect of them."""
        without = _registered_residuals(measurement, [each for each in named if each not in out], residuals, trained)
        known = np.isfinite(whole.value) & np.isfinite(without.value)
        tested, learned = (
            _log_score_gain(whole, without, known & rows, residuals.at, patch_sigma) for rows in (~trained, trained)
        )
        return tested, learned * float(np.sum(known & ~trained)) / max(float(np.sum(known & trained)), 1.0)

    found = {item.name: gains([item]) for item in scored}
    moving = [item for item in scored if not item.spreads]
    if len(moving) > 1:
        tested, expected = gains(moving)
        if tested <= _gain_needed(expected):
            out = min(moving, key=lambda item: (item.kind != "empirical", found[item.name][0]))
            left = validate_effects(measurement, residuals, [each for each in named if each is not out], trained, reference_sigma)
            return ValidatedEffects(left.named, [out, *left.failed], left.weak)
    failed = [item for item in scored if found[item.name][0] <= _gain_needed_by(item, found[item.name][1])]
    measured = [replace(item, gain=found[item.name][0]) if item.name in found else item for item in named if item not in failed]
    weak = [item for item in measured if _is_weak(item)] if len(measured) > 1 else []
    return ValidatedEffects([item for item in measured if item not in weak], failed, weak)


def _is_weak(item: NamedEffect) -> bool:
    """Whether an effect gains no more than its standard error, that of a gain g being the root of 2 g, or may be none."""
    by = thresholds().validation
    return (
        item.kind == "physical"
        and item.effect.scored()
        and (item.gain <= by.least_gain_beside_others or _is_consistent_with_zero(item))
    )


def describe_weakness(item: NamedEffect) -> str:
    """Words for why an effect beside others is only mentioned."""
    if _is_consistent_with_zero(item):
        return "its value is within its uncertainty of none"
    return f"it gains {item.gain:.1f} on new blocks"


def _is_consistent_with_zero(item: NamedEffect) -> bool:
    """Whether the one value that an effect on the mean has lies within its uncertainty of none, so that others beside it do as
    well without it."""
    values = [(item.entry[key], std) for key, std in item.std.items() if std]
    if item.effect.shows_in != ShowsIn.MEAN or len(values) != 1:
        return False
    ((value, std),) = values
    return abs(value) < thresholds().validation.null_sigmas * std


def _gain_needed_by(item: NamedEffect, expected: float) -> float:
    return item.effect.held_out_gain or _gain_needed(expected)


@dataclass(frozen=True)
class _RegisteredResiduals:
    """Residuals (n,) against some model, registered, their predicted standard deviations, and what neighbours share of those."""

    value: FloatArray
    sigma: FloatArray
    shared: SharedNoise

    def log_score(self, rows: NDArray[np.int64], patch: NDArray[np.int64], reference_sigma: float) -> float:
        """Of some rows, in patches, in each of which the reference is off by one error of standard deviation `reference_sigma`.

        By Woodbury's identity and the determinant lemma, first for the patches' errors and then for what neighbours share.
        """
        value, sigma = self.value[rows], self.sigma[rows]
        field = self.shared.part(rows).field(len(rows))
        nodes, own = field.weights, np.maximum(sigma**2 - field.variance, _LEAST_WHITE_SHARE * sigma**2)
        total = np.bincount(patch, 1 / own)
        mean = np.bincount(patch, value / own) / total
        limit = thresholds().validation.clip_sigmas * sigma
        left = np.clip(value - mean[patch], -limit, limit)
        held = 1 / (1 / reference_sigma**2 + total) if reference_sigma else np.zeros(len(total))
        gathered = csr_array((1 / own, (patch, np.arange(len(rows)))))
        weighed = (left + mean[patch]) / own
        sums, node_sums = total * mean, gathered @ nodes
        square = np.sum((left + mean[patch]) * weighed) - np.sum(held * sums**2)
        size = np.sum(np.log(own)) - np.sum(np.log1p(-held * total))
        if nodes.shape[1]:
            matrix = (nodes.T @ nodes.multiply(1 / own[:, None]) - node_sums.T @ node_sums.multiply(held[:, None])).toarray()
            prior = cholesky(field.covariance, lower=True)
            root = cholesky(matrix + inverse_of(prior), lower=True)
            right = nodes.T @ weighed - node_sums.T @ (held * sums)
            square -= np.sum(solve_triangular(root, right, lower=True) ** 2)
            size += 2 * np.sum(np.log(np.diag(root)) + np.log(np.diag(prior)))
        return float(-0.5 * (square + size))


def _log_score_gain(
    whole: _RegisteredResiduals, without: _RegisteredResiduals, rows: BoolArray, at: FloatArray, sigma: float
) -> float:
    """Of the log score, with and without an effect, over some rows (n,).

    at: (n, 2) places on the wall; sigma: of the reference's error. What is an outlier with the effect and without has no say.
    """
    chosen = np.flatnonzero(rows & (_inliers(whole) | _inliers(without)))
    patch = patches(at[chosen], _POINTS_PER_PATCH)
    return whole.log_score(chosen, patch, sigma) - without.log_score(chosen, patch, sigma)


def _inliers(found: _RegisteredResiduals) -> BoolArray:
    """(n,) which residuals are no outliers: debris, and what fell, would move the mean of a patch."""
    z = found.value / found.sigma
    return np.asarray(np.abs(z) < thresholds().points.outlier_sigmas * max(nmad(z), 1.0))


def _gain_needed(expected: float) -> float:
    """The gain up to which an effect fails: none, or where little is expected, less than chance takes from it.

    The gain of a true effect, half a difference of two chi^2, has about twice its expectation as variance.
    """
    likely = max(expected, 0.0)
    return max(
        min(0.0, likely - thresholds().validation.shortfall_sigmas * float(np.sqrt(2 * likely))),
        -thresholds().validation.most_loss,
    )


def _registered_residuals(
    measurement: Measurement, named: list[NamedEffect], residuals: Residuals, trained: BoolArray
) -> _RegisteredResiduals:
    """Of all points against the model with some effects, registered by the points `trained`; NaN where they are not smooth."""
    found = aligned_with(measurement, named, residuals.index[trained]).residuals
    count = len(measurement.cloud.points)
    place = np.full(count, -1)
    place[found.index[found.smooth]] = np.flatnonzero(found.smooth)  # an edge where the beam goes by this model says nothing
    rows = place[residuals.index]
    known = rows >= 0
    value, sigma = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    pose = pose_of(found, rows[trained & known])
    value[known], sigma[known] = (found.value - found.pose @ pose)[rows[known]], found.sigma[rows[known]]
    return _RegisteredResiduals(value, sigma, found.shared_noise.part(rows))
