"""What each effect is worth on blocks that no step of naming has used: the Gaussian log score with it less that without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array

from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import Measurement
from pipeline.gap.decisions import decided
from pipeline.gap.mean.within_cell_noise import inverse_from_cholesky
from pipeline.gap.naming.entries import Named, settled_with
from pipeline.gap.residuals.alignment import fit_pose
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.geometry.mesh import FloatArray
from sensors.effects.base import ShowsIn

_POINTS_PER_PATCH = 30.0
_LEAST_OWN = 0.02
"""Share of a point's variance that counts as its own where a model says there is none."""


@dataclass(frozen=True)
class Scored:
    """Effects with their held-out gains, those that failed, and those that are too weak beside others to be committed to."""

    named: list[Named]
    failed: list[Named]
    weak: list[Named]


def score_effects(
    measurement: Measurement, residuals: Residuals, named: list[Named], trained: BoolArray, reference_sigma: float
) -> Scored:
    """Score each effect with all others in the model. trained: (n,) points by which to register; the others are scored.

    Effects on the mean may only make up for each other, and then each seems to be needed. So what all of them gain together is
    tested first; where that fails, the one that matters least goes, an empirical term before any other.
    """
    scored = [item for item in named if item.effect.scored()]
    if not scored or (~trained).sum() < 100:
        return Scored(named, [], [])
    whole = _value(measurement, named, residuals, trained)
    shared = float(np.mean(residuals.with_sigma_of_means.sigma**2 - residuals.sigma**2)) / _POINTS_PER_PATCH
    patch_sigma = float(np.sqrt(reference_sigma**2 + shared))

    def gains(out: list[Named]) -> tuple[float, float]:
        """Of some effects on the points that are scored, and what those that were trained let expect of them."""
        without = _value(measurement, [each for each in named if each not in out], residuals, trained)
        known = np.isfinite(whole.value) & np.isfinite(without.value)
        tested, learned = (_gain(whole, without, known & rows, residuals.wall_xy, patch_sigma) for rows in (~trained, trained))
        return tested, learned * float(np.sum(known & ~trained)) / max(float(np.sum(known & trained)), 1.0)

    found = {item.name: gains([item]) for item in scored}
    moving = [item for item in scored if not item.spreads]
    if len(moving) > 1:
        tested, expected = gains(moving)
        if tested <= _least(expected):
            out = min(moving, key=lambda item: (item.kind != "empirical", found[item.name][0]))
            left = score_effects(measurement, residuals, [each for each in named if each is not out], trained, reference_sigma)
            return Scored(left.named, [out, *left.failed], left.weak)
    failed = [item for item in scored if found[item.name][0] <= _least_of(item, found[item.name][1])]
    measured = [replace(item, gain=found[item.name][0]) if item.name in found else item for item in named if item not in failed]
    weak = [item for item in measured if _is_weak(item)] if len(measured) > 1 else []
    return Scored([item for item in measured if item not in weak], failed, weak)


def _is_weak(item: Named) -> bool:
    """Whether an effect gains no more than its standard error, that of a gain g being the root of 2 g, or may be none."""
    by = decided().held_out
    return item.kind == "physical" and item.effect.scored() and (item.gain <= by.least_beside or _may_be_none(item))


def weakness(item: Named) -> str:
    """Words for why an effect beside others is only mentioned."""
    if _may_be_none(item):
        return "its value is within its uncertainty of none"
    return f"it gains {item.gain:.1f} on new blocks"


def _may_be_none(item: Named) -> bool:
    """Whether the one value that an effect on the mean has lies within its uncertainty of none, so that others beside it do as
    well without it."""
    values = [(item.entry[key], std) for key, std in item.std.items() if std]
    if item.effect.shows_in != ShowsIn.MEAN or len(values) != 1:
        return False
    ((value, std),) = values
    return abs(value) < decided().held_out.sigmas_of_none * std


def _least_of(item: Named, expected: float) -> float:
    return item.effect.held_out_gain or _least(expected)


@dataclass(frozen=True)
class _Registered:
    """Residuals (n,) against some model, registered, their predicted standard deviations, and what neighbours share of those."""

    value: FloatArray
    sigma: FloatArray
    shared: GridCorrelatedNoise

    def log_score(self, rows: NDArray[np.int64], patch: NDArray[np.int64], reference_sigma: float) -> float:
        """Of some rows, in patches, in each of which the reference is off by one error of standard deviation `reference_sigma`.

        By Woodbury's identity and the determinant lemma, first for the patches' errors and then for what neighbours share.
        """
        value, sigma = self.value[rows], self.sigma[rows]
        field = self.shared.part(rows).node_field(len(rows))
        nodes, own = field.weights, np.maximum(sigma**2 - field.variance, _LEAST_OWN * sigma**2)
        total = np.bincount(patch, 1 / own)
        mean = np.bincount(patch, value / own) / total
        limit = decided().held_out.clip * sigma
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
            root = cholesky(matrix + inverse_from_cholesky(prior), lower=True)
            right = nodes.T @ weighed - node_sums.T @ (held * sums)
            square -= np.sum(solve_triangular(root, right, lower=True) ** 2)
            size += 2 * np.sum(np.log(np.diag(root)) + np.log(np.diag(prior)))
        return float(-0.5 * (square + size))


def _gain(whole: _Registered, without: _Registered, rows: BoolArray, at: FloatArray, sigma: float) -> float:
    """Of the log score, with and without an effect, over some rows (n,).

    at: (n, 2) places on the wall; sigma: of the reference's error. What is an outlier with the effect and without has no say.
    """
    chosen = np.flatnonzero(rows & (_usual(whole) | _usual(without)))
    patch = wall_blocks_by_points(at[chosen], _POINTS_PER_PATCH)
    return whole.log_score(chosen, patch, sigma) - without.log_score(chosen, patch, sigma)


def _usual(found: _Registered) -> BoolArray:
    """(n,) which residuals are no outliers: debris, and what fell, would move the mean of a patch."""
    z = found.value / found.sigma
    return np.asarray(np.abs(z) < decided().points.outlier * max(nmad(z), 1.0))


def _least(expected: float) -> float:
    """The gain up to which an effect fails: none, or where little is expected, less than chance takes from it.

    The gain of a true effect, half a difference of two chi^2, has about twice its expectation as variance.
    """
    likely = max(expected, 0.0)
    return max(min(0.0, likely - decided().held_out.sigmas * float(np.sqrt(2 * likely))), -decided().held_out.most_lost)


def _value(measurement: Measurement, named: list[Named], residuals: Residuals, trained: BoolArray) -> _Registered:
    """Of all points against the model with some effects, registered by the points `trained`; NaN where they are not smooth."""
    found = settled_with(measurement, named, residuals.index[trained]).residuals
    count = len(measurement.cloud.points)
    place = np.full(count, -1)
    place[found.index[found.usable]] = np.flatnonzero(found.usable)  # an edge where the beam goes by this model says nothing
    rows = place[residuals.index]
    known = rows >= 0
    value, sigma = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    pose = fit_pose(found, rows[trained & known])
    value[known], sigma[known] = (found.value - found.pose_jacobian @ pose)[rows[known]], found.sigma[rows[known]]
    return _Registered(value, sigma, found.correlated_noise.part(rows))
