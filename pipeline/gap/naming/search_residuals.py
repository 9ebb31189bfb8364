"""Residuals for a search: with fitted noise, and on the points of an earlier search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.gap.noise_and_edges.variance_model import VarianceTerm
from pipeline.gap.residuals.residuals import Residuals
from sensors.effects import effect_of
from sensors.effects.matching_noise import MatchingNoise


def with_added_variance(part: Residuals, variance: float) -> Residuals:
    """Return a copy of residuals with more predicted noise, to account for an error found before, such as rounded ranges.

    variance: variance to add at every point, squared unit of the observable (m² or px²).
    """
    return replace(part, sigma=np.sqrt(part.sigma**2 + variance)) if variance else part


def with_fitted_variance(part: Residuals, noise_terms: list[VarianceTerm], noise_ratio: float) -> Residuals:
    """Return a copy of residuals with fitted noise in place of the predicted one, to weight a search for sensor errors.

    The search compares means over many neighbouring points, so the returned standard deviations hold for such means. Where
    neighbours share noise they are larger than those of single points.

    Parameters
    ----------
    part : residuals with their predicted standard deviations.
    noise_terms : noise terms that were fitted, each with the variance that it adds.
    noise_ratio : observed over predicted standard deviation. If there are no noise terms, the predicted standard deviations are
        multiplied by it.
    """
    part = part.with_sigma_of_means
    if not noise_terms:
        return replace(part, sigma=part.sigma * noise_ratio)
    made = (effect_of(each.effect)(**each.parameters) for each in noise_terms if each.parameters)
    shared = [effect for effect in made if isinstance(effect, MatchingNoise)]
    sigma = np.sqrt(part.sigma**2 + sum(each.variance for each in noise_terms))
    return replace(part, sigma=sigma, correlated_noise=part.correlated_noise.with_effects(shared))
