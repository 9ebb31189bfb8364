"""Simulate the null distribution: how large the log-likelihood ratio of every family gets without any effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.gap.mean.design import NULL_DRAWS, Design
from pipeline.gap.mean.mean_model import CellCovariance
from scene.common.keyed_random import KeyedRandom
from scene.common.threads import map_in_threads
from scene.geometry.mesh import FloatArray

_NEAR_NULL = 8
"""Number of the most likely covariances at which the draws are fitted."""


@dataclass(frozen=True)
class NullDistribution:
    """Distribution of the log-likelihood ratios that candidate errors reach by chance, from simulations without any effect.

    The simulations contain pose, correlated error of the reference surface and noise only. Penalties and p-values are taken
    from them. A family is the set of all variants of one candidate, such as an effect with all trial periods.

    Attributes
    ----------
    log_likelihood_ratios : For each family by name, the (499,) ratios of its best variant, one for each simulation.
    """

    log_likelihood_ratios: Mapping[str, FloatArray]

    @classmethod
    def of(cls, design: Design, random: KeyedRandom, ranked: Sequence[int] | None = None) -> NullDistribution:
        """Simulate the null distribution of a search: measurements without any sensor error, on which all candidates are tried.

        To save time, simulations are drawn under the most likely trial covariance of the reference error and fitted under the
        eight most likely ones.

        Parameters
        ----------
        design : The regression problem of the search.
        random : Source of the random numbers.
        ranked : Indices of the trial covariances in `design.equations`, the most likely first. None: as the measured residuals
            rank them.
        """
        likely = (design.ranked_covariances if ranked is None else list(ranked))[:_NEAR_NULL]
        near = design.equations.at_covariances(likely)
        draws = design.model.null_draws(near.covariances[0], NULL_DRAWS, random.child("between"))

        def values(at: CellCovariance) -> tuple[FloatArray, FloatArray, FloatArray]:
            weighted = draws[at.basis] * at.weight[:, None]
            constant = 0.5 * (np.log(at.weight).sum() - np.sum(draws[at.basis] * weighted, axis=0))
            right = design.noise_products + design.fixed.between[at.basis].T @ weighted
            return right, constant, design.sine_products.noise + design.sine_products.between[at.basis].T @ weighted

        right, constant, waves = (np.stack(part) for part in zip(*map_in_threads(values, near.covariances), strict=True))
        drawn = replace(near, right=right, constant=constant, wave_right=waves)
        plain, fixed, searched = drawn.profile_log_likelihood(design.pose_columns, design.plain_columns)
        return cls(
            {
                name: np.maximum(np.concatenate([fixed[rows], searched[numbers]]).max(axis=0) - plain, 0.0)
                for name, (rows, numbers) in design.families.by_name.items()
            }
        )

    def penalty(self, family: str) -> float:
        """Return a family's penalty, which is subtracted from its log-likelihood ratio to give its score.

        It is twice the mean ratio that the family (all variants of one candidate) reaches by chance. That is k for k linear
        coefficients, as in Akaike's criterion (AIC), and more for a searched period.
        """
        return 2 * float(self.log_likelihood_ratios[family].mean())

    def p_value(self, score: float, larger: Mapping[str, float] | None = None) -> float:
        """Return the p-value of a candidate's score: the probability that chance alone gives a score as large.

        The test statistic is the largest score over all families of candidates, which corrects for multiple testing. If it
        reaches the given score in b of N simulations without effects, the p-value is (1 + b) / (1 + N).

        score: penalised log-likelihood ratio of the candidate. larger: for the name of each family that takes part in the test,
        a factor by which its simulated log-likelihood ratios are multiplied; above 1 the test is stricter. None: all families,
        with factor 1.
        """
        return float((1 + np.sum(self._largest_scores(larger) >= score)) / (1 + NULL_DRAWS))

    def critical_score(self, significance: float, larger: Mapping[str, float] | None = None) -> float:
        """Return the score that a candidate must exceed for its p-value to be at most `significance`.

        It is a quantile of the largest score over all families of candidates in simulations without effects.

        significance: largest p-value, such as 0.01. larger: factors on the simulated ratios, as for `p_value`.
        """
        allowed = max(int(significance * (1 + NULL_DRAWS) + 1e-9) - 1, 0)
        return float(np.sort(self._largest_scores(larger))[-1 - allowed])

    def _largest_scores(self, larger: Mapping[str, float] | None) -> FloatArray:
        """(NULL_DRAWS,) largest score over the families in each simulation."""
        times = dict.fromkeys(self.log_likelihood_ratios, 1.0) if larger is None else larger
        scores = np.stack([each * self.log_likelihood_ratios[name] - self.penalty(name) for name, each in times.items()])
        return np.asarray(scores.max(axis=0))
