"""Compute the detectable size of each noise term: the variance model would have found it with a probability of 95 %."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.change.robust import nmad
from pipeline.gap.mean.detection_power import DetectableSize
from pipeline.gap.noise_and_edges.sign_flips import null_critical_score
from pipeline.gap.noise_and_edges.variance_model import standardised_deviations, variance_candidates
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.residuals.wall_blocks import WallCells
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

_ONE_SIDED = 1.645
"""Standard deviations that a normal variable exceeds with a probability of 5 %."""
_SIZES = np.geomspace(1e-4, 1e4, 321)
"""Variances that are tried, relative to the variance at the effect's typical sizes."""


def detectable_noise(
    residuals: Residuals, cells: WallCells, value: FloatArray, named: Sequence[str], random: KeyedRandom
) -> list[DetectableSize]:
    """Compute from which size on noise terms would have been found in a measurement with a probability of 95 %.

    Parameters
    ----------
    residuals : Residuals of n points with their predicted standard deviations.
    cells : Small squares of the wall; deviations from a plane within each are used.
    value : (n,) residuals after the systematic effects are removed, m (ranges) or px (disparities).
    named : Names of effects that were found, which are not listed.
    random : Source of random numbers, for the null distribution of the test statistic.

    Returns
    -------
    list : for each noise effect of the catalogue, the name of its main parameter and the detectable value of this parameter.
    """
    candidates = variance_candidates(residuals)
    if not candidates:
        return []
    z = standardised_deviations(residuals, cells, value)
    if not np.isfinite(z).any():
        return []
    used = np.isfinite(z) & (np.abs(z) < thresholds().points.outlier_sigmas * max(1.0, nmad(z, 0.0)))
    squares = z[used] ** 2 / float(np.mean(z[used] ** 2))
    block = np.unique(cells.blocks.numbers(residuals.wall_xy[used]), return_inverse=True)[1]
    shapes = [(each.variance[used] / residuals.sigma[used, None] ** 2).sum(axis=1) for each in candidates]
    critical = null_critical_score(squares, shapes, block, random)
    missing = 1 - min(float(np.mean(z[used] ** 2)), 1.0)
    found: dict[str, DetectableSize] = {}
    for candidate, shape in zip(candidates, shapes, strict=True):
        if candidate.name in named:
            continue
        name, size = candidate.main_parameter(_least_variance(squares, shape, block, critical, missing))
        item = DetectableSize(candidate.name, name, size, dict(candidate.fixed))
        if candidate.name not in found or item.size < found[candidate.name].size:
            found[candidate.name] = item
    return list(found.values())


def _least_variance(squares: FloatArray, shape: FloatArray, block: NDArray[np.int64], critical: float, missing: float) -> float:
    """Return the smallest variance that passes all tests of the variance model with a probability of 95 %.

    Parameters
    ----------
    squares : (n,) squared deviations, with mean 1.
    shape : (n,) the term's variance over the predicted one.
    block : (n,) wall block of each point.
    critical : Standardised score that must be exceeded.
    missing : Share by which the observed variance is below the predicted one; the term must make up for it first.
    """
    by = thresholds().variance
    of_null, of_term = np.bincount(block, (squares - 1) * shape), np.bincount(block, shape**2)
    mean_error = float(np.linalg.norm(np.bincount(block, squares - 1))) / len(squares)
    for theta in _SIZES:
        added = theta * shape
        score = float(theta * of_term.sum() / np.sqrt(np.sum(of_null**2 + (theta * of_term) ** 2)))
        gain = 0.5 * float(np.sum(added - np.log1p(added)))
        excess = float(np.mean(added)) - missing
        if (
            score - _ONE_SIDED > critical
            and gain - _ONE_SIDED * np.sqrt(2 * gain) > by.least_gain
            and excess - _ONE_SIDED * mean_error > by.least_excess
        ):
            return float(theta)
    return np.inf
