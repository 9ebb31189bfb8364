"""Residuals for a search: with fitted noise, and on the points of an earlier search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.residuals import Residuals
from sensors.effects import effect_of
from sensors.effects.matching_noise import MatchingNoise


def with_added_variance(part: Residuals, variance: float) -> Residuals:
    """Return residuals whose predicted variance is increased by `variance`, in squared units of the observable."""
    return replace(part, sigma=np.sqrt(part.sigma**2 + variance)) if variance else part


def with_fitted_variance(part: Residuals, noise_terms: list[VarianceTerm], noise_ratio: float) -> Residuals:
    """Return residuals with fitted noise instead of the predicted one, for weights in a search.

    The standard deviations are those that count for means over many neighbours.

    Parameters
    ----------
    part : residuals.
    noise_terms : fitted noise terms; without any, the predicted standard deviations are multiplied by `noise_ratio`.
    noise_ratio : observed over predicted standard deviation.
    """
    part = part.with_sigma_of_means
    if not noise_terms:
        return replace(part, sigma=part.sigma * noise_ratio)
    made = (effect_of(each.effect)(**each.parameters) for each in noise_terms if each.parameters)
    shared = [effect for effect in made if isinstance(effect, MatchingNoise)]
    sigma = np.sqrt(part.sigma**2 + sum(each.variance for each in noise_terms))
    return replace(part, sigma=sigma, correlated_noise=part.correlated_noise.with_effects(shared))
