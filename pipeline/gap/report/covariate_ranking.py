"""Along which covariates mean, spread, shape or losses depart from what the model predicts, before anything is named."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.naming.workflow import GapDiagnosis
from pipeline.gap.residuals.residuals import ExpectedPulses, Residuals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.geometry.mesh import FloatArray

_BINS = 12
_MOST_ROWS = 10
_INNER = 6.0
"""Residuals beyond this many predicted sigmas count as outliers in mean and spread."""
_EFFECTIVE = 60
"""Points of one bin that count as independent of each other: those of one block share the reference's error."""
_TAIL, _TAIL_SHARE = 3.0, 0.0027
_LEAST_P = 1e-3
_PATCHES, _LEAST_PULSES = 150, 60
"""Of the wall, by which losses are counted, and the fewest pulses of one: a shrub takes few patches, a bin has a dozen."""
_MARGIN_M = 0.3
"""Points this near to the box of a scene change count as part of it."""


def where(found: GapDiagnosis) -> list[dict[str, Any]]:
    """As gap.json holds it, the clearest first: each covariate's bin that departs most, by statistic.

    A mean's `size_m` is positive where the measured surface lies deeper than the predicted one.
    """
    residuals = found.residuals
    rows = [row for name, x, z in standardised(found) for row in _rows(name, x, z, residuals)]
    if residuals.expected_pulses is not None and residuals.expected_pulses.lost.any():
        patch = wall_blocks_by_points(
            residuals.expected_pulses.wall_xy, max(len(residuals.expected_pulses.lost) / _PATCHES, _LEAST_PULSES)
        )
        rows += [_lost(name, x, residuals.expected_pulses, patch) for name, x in residuals.expected_pulses.covariates.items()]
    return sorted(rows, key=lambda row: (row["p_value"], -abs(row["size_m"])))[:_MOST_ROWS]


def standardised(found: GapDiagnosis) -> list[tuple[str, FloatArray, FloatArray]]:
    """Name and values of each covariate, and the residuals before over their predicted sigma, on smooth parts, no outliers."""
    residuals = found.residuals
    kept = steady(found)
    z = found.before[kept] / residuals.sigma[kept]
    return [(name, values[kept], z) for name, values in residuals.covariates.items()] if kept.any() else []


def steady(found: GapDiagnosis) -> Any:
    """(n,) points on smooth parts of the surface, outside of scene changes, whose residual before is no outlier."""
    residuals = found.residuals
    kept = residuals.usable & (np.abs(found.before) < _INNER * residuals.sigma)
    for change in found.changes:
        low, high = change.bounds[:, :2] + np.array([[-_MARGIN_M], [_MARGIN_M]])
        kept = kept & ~((residuals.wall_xy >= low) & (residuals.wall_xy <= high)).all(axis=1)
    return kept


def bins(x: FloatArray, count: int) -> tuple[FloatArray, Any]:
    """Edges of bins of about equal numbers, and each value's bin; fewer than three edges where x hardly varies."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, count + 1)))
    return edges, np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(len(edges) - 2, 0))


def _rows(name: str, x: FloatArray, z: FloatArray, residuals: Residuals) -> list[dict[str, Any]]:
    edges, group = bins(x, _BINS)
    if len(edges) < 3:
        return []
    size = len(edges) - 1
    count = np.maximum(np.bincount(group, minlength=size), 1)
    effective = np.minimum(count, _EFFECTIVE)
    mean = np.bincount(group, z, size) / count
    spread = np.sqrt(np.maximum(np.bincount(group, z**2, size) / count - mean**2, 0))
    inner = np.abs(z - mean[group]) > _TAIL * np.maximum(spread[group], 1e-12)
    tails = np.bincount(group, inner, size) / count - _TAIL_SHARE
    metres = float(np.median(residuals.sigma * residuals.unit_m))
    deeper = float(np.sign(np.median(residuals.depth_m)))
    found = []
    for statistic, departs, sigmas in (
        ("mean", deeper * mean, np.abs(mean) * np.sqrt(effective)),
        ("spread", spread - 1, np.abs(spread - 1) * np.sqrt(2 * effective)),
        ("shape", _TAIL * tails, np.abs(tails) * np.sqrt(count / _TAIL_SHARE)),
    ):
        worst = int(np.argmax(sigmas))
        found.append(_row(name, statistic, edges, worst, float(sigmas[worst]), float(departs[worst]) * metres))
    return found


def _lost(name: str, x: FloatArray, missing: ExpectedPulses, patch: NDArray[np.int64]) -> dict[str, Any]:
    """Losses come many at a time, behind a shrub say. So a bin's deviate by as much as the patches within it do from their mean,
    and by as much as all patches do from the means of their bins, whichever is more."""
    edges, group = bins(x, _BINS)
    size = max(len(edges) - 1, 1)
    share, count = float(missing.lost.mean()), np.maximum(np.bincount(group, minlength=size), 1)
    own = np.bincount(group, missing.lost, size) / count
    part, of_part = np.unique(patch * size + group, return_inverse=True)
    parts = np.bincount(part % size, minlength=size)
    squares = np.bincount(part % size, np.bincount(of_part, missing.lost - own[group]) ** 2, size)
    scatter = squares * (parts / np.maximum(parts - 1, 1))
    independent = max(share * (1 - share), 1e-9)
    clustering = max(float(scatter.sum()) / (independent * len(group)), 1.0)
    sigmas = np.abs(own - share) * count / np.sqrt(np.maximum(scatter, clustering * independent * count))
    worst = int(np.argmax(sigmas))
    row = _row(name, "missing", edges if len(edges) > 1 else np.repeat(edges, 2), worst, float(sigmas[worst]), 0.0)
    return {**row, "share_lost": float(own[worst]), "share_lost_overall": share}


def _row(name: str, statistic: str, edges: FloatArray, worst: int, sigmas: float, size_m: float) -> dict[str, Any]:
    """p_value: Gaussian tail bound over the bins, as large as the statistic of the worst one can be by chance."""
    p_value = float(min(1.0, max(2 * len(edges) * np.exp(-(sigmas**2) / 2), _LEAST_P)))
    region = {"from": float(edges[worst]), "to": float(edges[worst + 1])}
    return {"covariate": name, "statistic": statistic, "p_value": p_value, "region": region, "size_m": size_m}
