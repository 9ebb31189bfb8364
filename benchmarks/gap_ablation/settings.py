"""The value of each threshold with which the rule behind it never acts, and why some thresholds have none."""

from __future__ import annotations

from typing import Any

from benchmarks.varied import Setting
from pipeline.gap.thresholds import Thresholds

LARGE = 1e9
OFF: dict[str, float] = {
    "points.fewest": 1,
    "points.fewest_epochs": 10**9,
    "points.most_reference_scatter": LARGE,
    "points.reference_error": LARGE,
    "points.least_share_on_reference": 0.0,
    "mean.class_margin": 0.0,
    "mean.class_share": 0.0,
    "mean.most_effects": 9,
    "mean.refit_share": 0.0,
    "mean.refit_gain": 0.0,
    "mean.most_reference_error": LARGE,
    "variance.least_gain": -LARGE,
    "variance.least_excess": 0.0,
    "variance.least_unshared_share": -LARGE,
    "variance.excess_noise_ratio": 1.0,
    "variance.nonparametric_share": 0.0,
    "variance.most_tail_share": LARGE,
    "variance.most_tail_unevenness": LARGE,
    "locking.fewest_cycles": 0.0,
    "locking.crowding_ratio": 1.0,
    "edges.least_gain": -LARGE,
    "edges.block_sigmas": -LARGE,
    "edges.least_block_sigmas": -LARGE,
    "edges.least_filled_share": 0.0,
    "missing_returns.cutoff_ratio": LARGE,
    "missing_returns.least_agreement": 0.0,
    "missing_returns.early_m": 0.0,
    "changes.fewest": 1,
    "changes.faint_sigmas": LARGE,
    "changes.margin": 0.0,
    "changes.moved_share": LARGE,
    "verdict.block_p": 1.0,
    "verdict.least_closed": -LARGE,
    "verdict.overdispersion": LARGE,
}
"""A minimum is 0 or far below; a maximum is far above; a ratio of two scores is 1."""

_SIGNIFICANCE = "it is a significance level, without which nothing is tested"
_ROBUST = "it bounds the weight of outliers in every fit, so each case depends on it"
KEPT_OUT: dict[str, str] = {
    "points.most": "it bounds the memory",
    "points.outlier_sigmas": _ROBUST,
    "points.registration_outlier_sigmas": _ROBUST,
    "mean.significance": _SIGNIFICANCE,
    "mean.prior_size": "it is a prior, and no rule",
    "variance.tail_sigmas": "it defines what an outlier is; `most_tail_share` decides",
    "locking.significance": _SIGNIFICANCE,
    "quantization.least_resultant": "it is the test itself: every scan would count as rounded",
    "verdict.rejection_p": _SIGNIFICANCE,
    "verdict.gap_sigmas": _SIGNIFICANCE,
}
"""Thresholds without a value that switches off one rule, with the reason."""

MERGED: dict[str, float] = {
    "mean.class_margin": 5.0,
    "variance.least_gain": 4.0,
    "locking.significance": 0.004,
    "edges.least_gain": 12.0,
}
"""For some thresholds, the value of a similar one. If no answer changes with it, one threshold can serve for both."""


def others(key: str) -> dict[Setting, Any]:
    """Return a threshold's other values by (key, "off") and (key, "merged")."""
    tables = {"off": OFF, "merged": MERGED}
    return {(key, name): values[key] for name, values in tables.items() if key in values}


def changed(settings: list[Setting]) -> Thresholds:
    """Return the thresholds with some of them changed; values beyond their bounds are allowed."""
    found = Thresholds()
    for key, name in settings:
        group, field = key.split(".")
        values = getattr(found, group).model_copy(update={field: others(key)[key, name]})
        found = found.model_copy(update={group: values})
    return found
