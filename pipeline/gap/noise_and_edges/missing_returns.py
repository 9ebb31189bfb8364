"""Explain missing returns by a Bernoulli model of the pulses: losses that grow with range, or that fall on weak echoes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit, ndtr

from pipeline.gap.noise_and_edges.variance_fit import quantile_group
from pipeline.gap.residuals.residuals import BoolArray, ExpectedPulses
from pipeline.gap.residuals.wall_blocks import agreement, wall_blocks_by_points
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray
from sensors.effects import catalogue
from sensors.effects.base import ShowsIn
from sensors.effects.detection_limit import DetectionLimit
from sensors.effects.precipitation import Precipitation

LOSS_EFFECTS = tuple(effect.tag() for effect in catalogue("tls") if effect.shows_in == ShowsIn.RETURNS)
"""Names of the effects of the catalogue that make returns disappear."""
_PULSES_PER_PATCH = 60.0
_STRIPS = 8
"""Strips across a sector whose losses must agree."""
_DIRECTIONS = {"azimuth": "zenith", "zenith": "azimuth"}
"""Angles on which losses may depend without an effect of the catalogue, and the angle across each. Range, incidence and
power are explained by the catalogue."""
_BINS = 16
_MOST_PULSES = 20_000
"""Pulses that decide where the search for the best values starts."""
_LARGEST_LOG_POWER = 500.0
"""Bound of a limit's log power: where losses depend on nothing, the search diverges."""


@dataclass(frozen=True)
class LossExplanation:
    """An explanation of why m laser pulses did or did not return, such as rain or a detection limit.

    Attributes
    ----------
    name : name of the effect; for losses that were fitted freely to a covariate, the effect that stands for them in a model.
    gain : log-likelihood ratio against one probability of loss for all pulses.
    score : gain minus the number of parameters.
    parameters, std : values of the effect's parameters and their standard deviations, by parameter name.
    probability : (m,) probability of losing each pulse.
    covariate : name of the covariate, such as a direction, to which losses were fitted freely; else "".
    """

    name: str
    gain: float
    score: float
    parameters: dict[str, float]
    std: dict[str, float]
    probability: FloatArray
    covariate: str = ""


@dataclass(frozen=True)
class _Losses:
    """Losses of m laser pulses, to which models of their probability are fitted.

    lost: (m,) whether each pulse was lost; fit: (m,) true for pulses that are used for fitting.
    """

    lost: BoolArray
    fit: BoolArray

    @cached_property
    def log_likelihood(self) -> float:
        """Log-likelihood with one probability for all pulses, with which models are compared."""
        lost = self.lost[self.fit]
        return bernoulli_log_likelihood(lost, np.full(len(lost), lost.mean()))

    def fitted(
        self, probability: Callable[[FloatArray, FloatArray], FloatArray], x: FloatArray, starts: list[FloatArray]
    ) -> tuple[FloatArray, Callable[[FloatArray], float]]:
        """Fit a model of the probability of a loss by maximum likelihood.

        Parameters
        ----------
        probability : function of the model's parameters and of covariate values, which returns the probability for each value.
        x : (m,) covariate of each pulse, such as its range.
        starts : parameter vectors; the search begins at the most likely one.

        Returns
        -------
        tuple : the parameters, and the negative log-likelihood as a function of parameters.
        """
        seen, lost = x[self.fit], self.lost[self.fit]
        every = slice(None, None, max(len(lost) // _MOST_PULSES, 1))
        first = max(starts, key=lambda start: bernoulli_log_likelihood(lost[every], probability(start, seen[every])))

        def cost(values: FloatArray) -> float:
            return -bernoulli_log_likelihood(lost, probability(values, seen))

        options = {"maxiter": 150, "xatol": 1e-3, "fatol": 0.05}
        return minimize(cost, first, method="Nelder-Mead", options=options).x, cost


def explain_missing_returns(
    missing: ExpectedPulses, fit: BoolArray, early: int, points: int, intensity: FloatArray | None
) -> LossExplanation | None:
    """Find the effect that explains which laser pulses did not return; None if no explanation improves the likelihood enough.

    Losses come in clusters (shrubs, wet rock), so a likelihood of independent pulses is overconfident. Log-likelihood ratios
    are therefore divided by the overdispersion: how much more losses vary between parts of the wall than independent ones
    would.

    Parameters
    ----------
    missing : m pulses that should have hit the reference, whether they returned, and covariates such as the range.
    fit : (m,) true for pulses to use for fitting.
    early : number of returns from far in front of the wall, which may be rain drops or snow flakes.
    points : number of returns among which `early` were counted.
    intensity : (n,) recorded powers of the returns, to find a detection limit; None if not recorded.
    """
    losses = _Losses(missing.lost, fit)
    limit = _fit_detection_limit(losses, missing.covariates["log_power"])
    if intensity is not None and not _ends_abruptly(intensity):
        limit = replace(limit, score=-np.inf)
    precipitation = _fit_precipitation(losses, missing.covariates["range"], early, points)
    best = max((limit, precipitation), key=lambda each: each.score)
    free = _fit_directional_losses(losses, missing.covariates)
    ahead = free.score - max(best.score, 0.0)
    if ahead > thresholds().variance.least_gain and _strips_agree(missing, best, free, fit):
        best = free
    confidence = 1 / _overdispersion(missing.lost[fit], best.probability[fit], missing.wall_xy[fit])
    if best.score * confidence < thresholds().variance.least_gain:
        return None
    std = {key: value / np.sqrt(confidence) for key, value in best.std.items()}
    return replace(best, gain=best.gain * confidence, score=best.score * confidence, std=std)


def count_isolated_returns(at: FloatArray, early: BoolArray) -> int:
    """Count returns from rain drops or snow flakes in front of the wall; 0 if they come from objects.

    Drops return single pulses scattered over the wall; an object returns many pulses side by side.

    Parameters
    ----------
    at : (n, 2) positions of all returns, x along the wall and y up, wall frame, m.
    early : (n,) true for returns from far in front of the wall.
    """
    patch, count = wall_blocks_by_points(at, _PULSES_PER_PATCH), int(early.sum())
    number = int(patch.max()) + 1
    anywhere = number * (1 - (1 - 1 / number) ** count)
    return count if len(np.unique(patch[early])) >= thresholds().missing_returns.least_agreement * anywhere else 0


def _overdispersion(lost: BoolArray, probability: FloatArray, at: FloatArray) -> float:
    """Variance of the patches' losses over that of independent ones, at least 1."""
    patch = wall_blocks_by_points(at, _PULSES_PER_PATCH)
    left = np.bincount(patch, lost - probability)
    expected = np.bincount(patch, probability * (1 - probability))
    return float(max(np.sum(left**2) / np.sum(expected), 1.0))


def _strips_agree(missing: ExpectedPulses, known: LossExplanation, free: LossExplanation, fit: BoolArray) -> bool:
    """Whether losses by one angle occur in all strips of the other angle. Each strip is predicted from the losses of the others.

    A shrub before the wall takes pulses in a few strips only, and so do lines that the scanner dropped.
    """
    lost, across = missing.lost[fit], missing.covariates[_DIRECTIONS[free.covariate]][fit]
    strip, group = quantile_group(across, _STRIPS), quantile_group(missing.covariates[free.covariate], _BINS)[fit]
    sent, gone = (np.bincount(strip * _BINS + group, each, _STRIPS * _BINS).reshape(_STRIPS, _BINS) for each in (None, lost))
    others = (gone.sum(axis=0) - gone + 0.5) / (sent.sum(axis=0) - sent + 1.0)
    p, q = np.clip(known.probability[fit], 1e-9, 1 - 1e-9), others[strip, group]
    sums = np.bincount(strip, np.where(lost, np.log(q / p), np.log1p(-q) - np.log1p(-p)), _STRIPS)
    return agreement(sums) > thresholds().missing_returns.least_agreement * np.sqrt(_STRIPS)


def _ends_abruptly(intensity: FloatArray) -> bool:
    """Whether the recorded powers end abruptly, as at a detection limit, and do not thin out.

    Below a limit the density drops to zero, so the lowest percent of the log powers covers twice the interval of the lowest
    half percent (ratio 0.5). The tail of a normal distribution gives 0.8.
    """
    ordered = np.sort(np.log(np.maximum(intensity, 1e-12)))
    low, middle, high = (float(ordered[int(share * (len(ordered) - 1))]) for share in (0.0005, 0.005, 0.01))
    return (middle - low) < thresholds().missing_returns.cutoff_ratio * (high - low)


def _fit_detection_limit(losses: _Losses, log_power: FloatArray) -> LossExplanation:
    """P = p0 + (1 - p0) Phi((ln P_min - ln rho - ln(cos i / R^2)) / s), for an unknown, log-normal albedo rho."""

    def probability(values: FloatArray, x: FloatArray) -> FloatArray:
        base = expit(values[2])
        return np.asarray(base + (1 - base) * ndtr((values[0] - x) / np.exp(values[1])))

    starts = [
        np.array([level - spread, np.log(spread), logit(base)])
        for spread in (0.05, 0.2, 0.5)
        for level in np.quantile(log_power, [0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95])
        for base in (0.003, 0.02, 0.08)
    ]
    best, cost = losses.fitted(probability, log_power, starts)
    gain = -cost(best) - losses.log_likelihood
    value = float(np.exp(np.clip(best[0], -_LARGEST_LOG_POWER, _LARGEST_LOG_POWER)) * 0.5)
    parameters, std = {"minimum_power": value}, {"minimum_power": value * float(np.exp(best[1]))}
    return LossExplanation(DetectionLimit.tag(), gain, gain - 3.0, parameters, std, probability(best, log_power))


def _fit_precipitation(losses: _Losses, range_m: FloatArray, early: int, points: int) -> LossExplanation:
    """P = 1 - (1 - p0) exp(-2 beta R). Early returns count as drops if there are more than a few."""

    def probability(values: FloatArray, x: FloatArray) -> FloatArray:
        return np.asarray(1 - (1 - expit(values[1])) * np.exp(-2 * np.exp(values[0]) * x))

    starts = [np.array([np.log(rate), logit(base)]) for rate in np.geomspace(1e-6, 0.05, 20) for base in (0.003, 0.01, 0.03, 0.1)]
    best, cost = losses.fitted(probability, range_m, starts)
    share = min(early / max(float(losses.lost.sum()) + early, 1.0), 1.0)
    rate = max(float(np.exp(best[0])) / max(1 - share, 1e-3), 1e-6)
    drops = 10.0 * early if early > max(5, 1e-4 * points) else 0.0
    std = {"rate_per_m": rate * _first_parameter_std(cost, best), "early_share": float(np.sqrt(share / max(early, 1)))}
    gain, parameters = -cost(best) - losses.log_likelihood + drops, {"rate_per_m": rate, "early_share": share}
    return LossExplanation(Precipitation.tag(), gain, gain - 2.0, parameters, std, probability(best, range_m))


def _first_parameter_std(cost: Callable[[FloatArray], float], top: FloatArray) -> float:
    """Return the standard deviation of the first of two parameters, from the curvature of `cost` at its minimum `top`.

    `cost` is a negative log-likelihood. The result is 1 where the curvature is not positive definite.
    """
    step = 0.05
    moves = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]])
    a, b, c, d, e, f = (cost(top + move) for move in moves)
    middle = cost(top)
    own, other = (a + b - 2 * middle) / step**2, (c + d - 2 * middle) / step**2
    both = (e + f - a - b - c - d + 2 * middle) / (2 * step**2)
    determinant = own * other - both**2
    return float(np.sqrt(other / determinant)) if determinant > 0 < other else 1.0


def _fit_directional_losses(losses: _Losses, covariates: dict[str, FloatArray]) -> LossExplanation:
    """Losses free in each bin of one angle (non-parametric); their mean is given as a rate of precipitation."""
    found, lost, fit = [], losses.lost, losses.fit
    rate = max(-float(np.log1p(-min(float(lost.mean()), 0.999))) / (2 * float(np.mean(covariates["range"]))), 1e-6)
    for name in _DIRECTIONS:
        group = quantile_group(covariates[name], _BINS)
        count = np.maximum(np.bincount(group[fit], minlength=_BINS), 1)
        probability = (np.bincount(group[fit], lost[fit], _BINS) / count)[group]
        gain = bernoulli_log_likelihood(lost[fit], probability[fit]) - losses.log_likelihood
        parameters = {"rate_per_m": rate, "early_share": 0.0}
        found.append(LossExplanation(Precipitation.tag(), gain, gain - _BINS, parameters, {}, probability, name))
    return max(found, key=lambda each: each.score)


def bernoulli_log_likelihood(happened: BoolArray, probability: FloatArray) -> float:
    """Return the log-likelihood of independent events (m,), such as losses of pulses, that happen with probability (m,)."""
    p = np.clip(probability, 1e-9, 1 - 1e-9)
    return float(np.sum(np.log(np.where(happened, p, 1 - p))))
