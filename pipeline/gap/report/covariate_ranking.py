"""Rank the covariates along which mean, standard deviation, outliers or missing returns differ most from the model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.residuals.residuals import BoolArray, ExpectedPulses, Residuals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.geometry.mesh import FloatArray

_BINS = 12
_MOST_ROWS = 10
_OUTLIER_SIGMAS = 6.0
"""Residuals beyond this many predicted standard deviations are left out of mean and standard deviation."""
_EFFECTIVE_POINTS = 60
"""Points of a bin that count as independent: points of one wall block share the reference error."""
_TAIL, _TAIL_SHARE = 3.0, 0.0027
_LEAST_P = 1e-3
_PATCHES, _LEAST_PULSES = 150, 60
"""Patches of the wall by which losses are counted, and fewest pulses of one. A shrub covers few patches, a bin has about a
dozen."""
_MARGIN_M = 0.3
"""Points this near to the box of a scene change count as part of it, m."""


def rank_disagreements(found: GapDiagnosis) -> list[dict[str, Any]]:
    """Find along which covariates (such as range or incidence angle), and at which values, measurement and model differ most.

    The values of each covariate are divided into bins. For each covariate and statistic of the residuals, the bin that differs
    most from the model is kept.

    Returns
    -------
    list : at most ten entries of `where` in gap.json, the most significant first. Keys: `covariate`; `statistic` ("mean",
        "spread" for standard deviation, "shape" for outliers, "missing" for lost returns); `p_value`; `region`, the bin's
        limits; and `size_m`, the difference in m (0 for lost returns), positive for a mean if the measured surface lies deeper
        than predicted. Entries on lost returns also have `share_lost` of the bin and `share_lost_overall`, 0 to 1.
    """
    residuals, used = found.residuals, inliers(found)
    rows, pulses, z = [], residuals.expected_pulses, found.before[used] / residuals.sigma[used]
    if used.any():
        for name, x in residuals.covariates.items():
            rows += _rank_statistics(name, x[used], z, residuals)
    if pulses is not None and pulses.lost.any():
        patch = wall_blocks_by_points(pulses.wall_xy, max(len(pulses.lost) / _PATCHES, _LEAST_PULSES))
        rows += [_rank_losses(name, x, pulses, patch) for name, x in pulses.covariates.items()]
    return sorted(rows, key=lambda row: (row["p_value"], -abs(row["size_m"])))[:_MOST_ROWS]


def inliers(found: GapDiagnosis) -> BoolArray:
    """Tell which of the n points of a diagnosis are used in profiles and rankings, as an (n,) mask.

    They lie on smooth, stable rock and not within 0.3 m of a region where the rock changed. Their residual without the named
    effects is below 6 predicted standard deviations.
    """
    residuals = found.residuals
    used = residuals.usable & (np.abs(found.before) < _OUTLIER_SIGMAS * residuals.sigma)
    for change in found.changes:
        low, high = change.bounds[:, :2] + np.array([[-_MARGIN_M], [_MARGIN_M]])
        used = used & ~((residuals.wall_xy >= low) & (residuals.wall_xy <= high)).all(axis=1)
    return used


def quantile_bins(x: FloatArray, count: int) -> tuple[FloatArray, Any]:
    """Divide values into bins with about equally many values, for profiles of residuals along a covariate.

    Parameters
    ----------
    x : (n,) values.
    count : number of bins.

    Returns
    -------
    tuple : edges of the bins, fewer than three if x hardly varies; and the (n,) number of each value's bin, from 0.
    """
    edges = np.unique(np.quantile(x, np.linspace(0, 1, count + 1)))
    return edges, np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(len(edges) - 2, 0))


def _rank_statistics(name: str, x: FloatArray, z: FloatArray, residuals: Residuals) -> list[dict[str, Any]]:
    """Entries of one covariate: the bin whose mean, standard deviation or share of outliers differs most."""
    edges, group = quantile_bins(x, _BINS)
    if len(edges) < 3:
        return []
    size = len(edges) - 1
    count = np.maximum(np.bincount(group, minlength=size), 1)
    effective = np.minimum(count, _EFFECTIVE_POINTS)
    mean = np.bincount(group, z, size) / count
    deviation_of_bin = np.sqrt(np.maximum(np.bincount(group, z**2, size) / count - mean**2, 0))
    beyond = np.abs(z - mean[group]) > _TAIL * np.maximum(deviation_of_bin[group], 1e-12)
    tails = np.bincount(group, beyond, size) / count - _TAIL_SHARE
    metres = float(np.median(residuals.sigma * residuals.unit_m))
    deeper = float(np.sign(np.median(residuals.depth_m)))
    return [
        _entry(name, "mean", edges, np.abs(mean) * np.sqrt(effective), deeper * mean * metres),
        _entry(name, "spread", edges, np.abs(deviation_of_bin - 1) * np.sqrt(2 * effective), (deviation_of_bin - 1) * metres),
        _entry(name, "shape", edges, np.abs(tails) * np.sqrt(count / _TAIL_SHARE), _TAIL * tails * metres),
    ]


def _rank_losses(name: str, x: FloatArray, missing: ExpectedPulses, patch: NDArray[np.int64]) -> dict[str, Any]:
    """Entry of the bin whose share of lost pulses differs most.

    Losses are clustered, for example behind a shrub. The variance of a bin's share is therefore the larger of two estimates: that
    of its own patches, and that of all patches about the means of their bins.
    """
    edges, group = quantile_bins(x, _BINS)
    size = max(len(edges) - 1, 1)
    share, count = float(missing.lost.mean()), np.maximum(np.bincount(group, minlength=size), 1)
    bin_share = np.bincount(group, missing.lost, size) / count
    part, of_part = np.unique(patch * size + group, return_inverse=True)
    parts = np.bincount(part % size, minlength=size)
    squares = np.bincount(part % size, np.bincount(of_part, missing.lost - bin_share[group]) ** 2, size)
    scatter = squares * (parts / np.maximum(parts - 1, 1))
    independent = max(share * (1 - share), 1e-9)
    clustering = max(float(scatter.sum()) / (independent * len(group)), 1.0)
    sigmas = np.abs(bin_share - share) * count / np.sqrt(np.maximum(scatter, clustering * independent * count))
    row = _entry(name, "missing", edges if len(edges) > 1 else np.repeat(edges, 2), sigmas, np.zeros(size))
    return {**row, "share_lost": float(bin_share[np.argmax(sigmas)]), "share_lost_overall": share}


def _entry(name: str, statistic: str, edges: FloatArray, sigmas: FloatArray, sizes_m: FloatArray) -> dict[str, Any]:
    """Entry of `where` for the most significant bin. Its p-value is a Gaussian tail bound for the largest of all bins."""
    worst = int(np.argmax(sigmas))
    p_value = float(min(1.0, max(2 * len(edges) * np.exp(-(float(sigmas[worst]) ** 2) / 2), _LEAST_P)))
    region = {"from": float(edges[worst]), "to": float(edges[worst + 1])}
    return {"covariate": name, "statistic": statistic, "p_value": p_value, "region": region, "size_m": float(sizes_m[worst])}
