"""Residuals for a search: with fitted noise, and on the points of an earlier search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.alignment import fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from pipeline.gap.thresholds import thresholds
from sensors.effects import effect_of
from sensors.effects.matching_noise import MatchingNoise


def with_added_variance(part: Residuals, variance: float) -> Residuals:
    """Add a variance to the predicted one."""
    return replace(part, sigma=np.sqrt(part.sigma**2 + variance)) if variance else part


def with_fitted_variance(part: Residuals, noise_terms: list[VarianceTerm], noise_ratio: float) -> Residuals:
    """Use the fitted noise in place of the predicted one, as it counts for means of neighbours.

    noise_terms: fitted noise terms; where there are none, the predicted standard deviations are multiplied by `noise_ratio`.
    """
    part = part.with_sigma_of_means
    if not noise_terms:
        return replace(part, sigma=part.sigma * noise_ratio)
    made = (effect_of(each.effect)(**each.parameters) for each in noise_terms if each.parameters)
    shared = [effect for effect in made if isinstance(effect, MatchingNoise)]
    sigma = np.sqrt(part.sigma**2 + sum(each.variance for each in noise_terms))
    return replace(part, sigma=sigma, correlated_noise=part.correlated_noise.with_effects(shared))


def at_points_of(found: Residuals, part: Residuals) -> Residuals:
    """Restrict residuals to the points of `part` that are smooth there too and no outliers."""
    registered_residuals, _, noise_ratio = fit_pose_robustly(found)
    good = found.usable & (np.abs(registered_residuals) < thresholds().points.outlier_sigmas * noise_ratio * found.sigma)
    place = np.full(int(max(found.index.max(initial=-1), part.index.max())) + 1, -1)
    place[found.index[good]] = np.flatnonzero(good)
    rows = place[part.index]
    return found.part(rows[rows >= 0])
