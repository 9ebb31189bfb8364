"""What was done with each threshold after the ablation, where that is not simply "kept"."""

from __future__ import annotations

_NONE_CAME = "kept: no case came to it, so nothing was measured"
_TESTED = "kept: a test of the program requires it"

DONE: dict[str, str] = {
    "points.fewest": "kept: below it the verdict is `insufficient_data`",
    "points.fewest_epochs": "kept: no case has several epochs",
    "points.least_share_on_reference": "kept: without points on the reference nothing can be fitted",
    "mean.most_reference_error": "kept: the user sets it by `--reference-error`",
    "mean.class_margin": "kept: it defines what cannot be told apart",
    "mean.same_covariate": "deleted; a term counts as a second one only if it has the same covariate",
    "variance.significance": "merged with `mean.significance`, which has the same value",
    "variance.class_share": "merged with `mean.class_share`, which has the same value",
    "variance.block_sigmas": "merged with `edges.block_sigmas`, which has the same value",
    "variance.nonparametric_margin": "merged with `mean.nonparametric_margin`, which changes no decision",
    "variance.nonparametric_gain": "deleted",
    "variance.nonparametric_block_sigmas": "merged into `edges.least_block_sigmas`",
    "variance.second_gain": "merged with `variance.least_gain`, which changes no decision",
    "variance.nonparametric_share": "kept: without it a right name becomes unknown",
    "variance.core_excess": _NONE_CAME,
    "grid_noise.margin": "merged with `variance.class_margin`, which changes no decision",
    "grid_noise.least_sigmas": "merged with `edges.block_sigmas`, which changes no decision",
    "grid_noise.short_reference_error": _NONE_CAME,
    "locking.most_noise": "now a constant: it ends a grid of trial values",
    "locking.equal_fit": "kept: without it a case has no answer",
    "locking.good_fit": _TESTED,
    "edges.footprint_block_sigmas": "now `edges.least_block_sigmas`",
    "edges.footprint_fewest": "deleted",
    "edges.clear_sigmas": "deleted",
    "edges.clear_step": "deleted: a rim must move a point by a depth step",
    "edges.most_relative_noise": "deleted; the simplest explanation is taken",
    "edges.least_filled_gain": "merged with `edges.least_gain`, which changes no decision",
    "missing_returns.least_isolated_share": "kept: it tells rain from objects, and no case has many early returns",
    "missing_returns.nonparametric_margin": "merged with `mean.nonparametric_margin`, which changes no decision",
    "missing_returns.nonparametric_ratio": "deleted; `mean.nonparametric_margin` decides",
    "missing_returns.early_sigmas": "deleted; `missing_returns.early_m` decides",
    "changes.largest_share": "kept: only compact regions are changes of the rock",
    "changes.stripe_length": "kept: only compact regions are changes of the rock",
    "changes.moved_sigmas": "merged with `changes.faint_sigmas`, which has the same value",
    "changes.moved_share": _TESTED,
    "changes.moved_share_beside_noise": _NONE_CAME,
    "validation.clip_sigmas": "merged with `points.outlier_sigmas`, which has the same value",
    "validation.null_sigmas": "merged with `verdict.gap_sigmas`, which has the same value; a test requires the rule",
    "validation.leftover_share": "deleted",
    "verdict.floor_sigmas": "now half of `verdict.rejection_p`: no score of 113 cases lies between",
}
