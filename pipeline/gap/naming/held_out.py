"""What each effect is worth on blocks that no step of naming has used: the Gaussian log score with it less that without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.formats.measurement import Measurement
from pipeline.gap.decisions import decided
from pipeline.gap.naming.entries import Named, settled_with
from pipeline.gap.residuals.cells import patches
from pipeline.gap.residuals.registration import pose_of
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from scene.mesh import FloatArray

_POINTS_PER_PATCH = 30.0


@dataclass(frozen=True)
class Scored:
    """Effects with their held-out gains, and those that failed."""

    named: list[Named]
    failed: list[Named]


def score_effects(
    measurement: Measurement, residuals: Residuals, named: list[Named], trained: BoolArray, reference_sigma: float
) -> Scored:
    """Score each effect with all others in the model. trained: (n,) points by which to register; the others are scored.

    Effects on the mean may only make up for each other, and then each seems to be needed. So what all of them gain together is
    tested first; where that fails, the one that matters least goes, an empirical term before any other.
    """
    scored = [item for item in named if item.effect.scored()]
    if not scored or (~trained).sum() < 100:
        return Scored(named, [])
    whole = _value(measurement, named, residuals, trained)

    def gains(out: list[Named]) -> tuple[float, float]:
        """Of some effects on the points that are scored, and what those that were trained let expect of them."""
        without = _value(measurement, [each for each in named if each not in out], residuals, trained)
        known = np.isfinite(whole[0]) & np.isfinite(without[0])
        tested, learned = (_gain(whole, without, known & rows, residuals.at, reference_sigma) for rows in (~trained, trained))
        return tested, learned * float(np.sum(known & ~trained)) / max(float(np.sum(known & trained)), 1.0)

    found = {item.name: gains([item]) for item in scored}
    moving = [item for item in scored if not item.spreads]
    if len(moving) > 1:
        tested, expected = gains(moving)
        if tested <= _least(expected):
            out = min(moving, key=lambda item: (item.kind != "empirical", found[item.name][0]))
            left = score_effects(measurement, residuals, [each for each in named if each is not out], trained, reference_sigma)
            return Scored(left.named, [out, *left.failed])
    failed = [item for item in scored if found[item.name][0] <= _least_of(item, found[item.name][1])]
    kept = [item for item in named if item not in failed]
    return Scored([replace(item, gain=found[item.name][0]) if item.name in found else item for item in kept], failed)


def _least_of(item: Named, expected: float) -> float:
    return item.effect.held_out_gain or _least(expected)


def _gain(
    whole: tuple[FloatArray, FloatArray], without: tuple[FloatArray, FloatArray], rows: BoolArray, at: FloatArray, sigma: float
) -> float:
    """Of the log score, by residuals and their standard deviations (n,) with and without an effect, over some rows.

    at: (n, 2) places on the wall; sigma: of the reference's error. What is an outlier with the effect and without has no say.
    """
    rows = rows & (_usual(*whole) | _usual(*without))
    patch = patches(at[rows], _POINTS_PER_PATCH)
    scores = [_log_score(value[rows], spread[rows], patch, sigma) for value, spread in (whole, without)]
    return scores[0] - scores[1]


def _usual(value: FloatArray, sigma: FloatArray) -> BoolArray:
    """(n,) which residuals are no outliers: debris, and what fell, would move the mean of a patch."""
    z = value / sigma
    return np.asarray(np.abs(z) < decided().points.outlier * max(nmad(z), 1.0))


def _least(expected: float) -> float:
    """The gain up to which an effect fails: none, or where little is expected, less than chance takes from it.

    The gain of a true effect, half a difference of two chi^2, has about twice its expectation as variance.
    """
    likely = max(expected, 0.0)
    return max(min(0.0, likely - decided().held_out.sigmas * float(np.sqrt(2 * likely))), -decided().held_out.most_lost)


def _value(
    measurement: Measurement, named: list[Named], residuals: Residuals, trained: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """(n,) residuals, registered by the points `trained`, and predicted sigma against the model with some effects."""
    found = settled_with(measurement, named, residuals.index[trained]).residuals
    count = len(measurement.cloud.points)
    place = np.full(count, -1)
    place[found.index[found.smooth]] = np.flatnonzero(found.smooth)  # an edge where the beam goes by this model says nothing
    rows = place[residuals.index]
    known = rows >= 0
    value, sigma = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    pose = pose_of(found, rows[trained & known])
    value[known], sigma[known] = (found.value - found.pose @ pose)[rows[known]], found.sigma[rows[known]]
    return value, sigma


def _log_score(value: FloatArray, sigma: FloatArray, patch: NDArray[np.int64], reference_sigma: float) -> float:
    """Of the patches' means, with the reference's error in their variance, and of the deviations from them."""
    weight = 1 / sigma**2
    total = np.bincount(patch, weight)
    mean = np.bincount(patch, weight * value) / total
    variance = 1 / total + reference_sigma**2
    left = np.clip((value - mean[patch]) / sigma, -decided().held_out.clip, decided().held_out.clip)
    among = -0.5 * np.sum(left**2) - np.sum(np.log(sigma)) + 0.5 * np.sum(np.log(1 / total))
    return float(among - 0.5 * np.sum(mean**2 / variance + np.log(variance)))
