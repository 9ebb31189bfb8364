"""Which effects explain the returns that are missing: losses that grow with range, or that fall on weak echoes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit, ndtr

from pipeline.gap.decisions import decided
from pipeline.gap.residuals.residuals import BoolArray, ExpectedPulses
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.geometry.mesh import FloatArray
from sensors.effects import catalogue
from sensors.effects.base import ShowsIn
from sensors.effects.detection_limit import DetectionLimit
from sensors.effects.precipitation import Precipitation

LOSSES = tuple(effect.tag() for effect in catalogue("tls") if effect.shows_in == ShowsIn.RETURNS)
_PULSES_PER_PATCH = 60.0
_STRIPS = 8
"""Across a sector, that must agree on its losses."""
_DIRECTIONS = {"azimuth": "zenith", "zenith": "azimuth"}
"""What losses may depend on for no reason of the catalogue (range, incidence and power have theirs), and what goes across it."""
_BINS = 16
_MOST_PULSES = 20_000
"""That decide where the search for a limit starts."""
_LARGEST_LOG = 500.0
"""Of a limit's power: where losses depend on nothing the search runs away."""


@dataclass(frozen=True)
class MissingFound:
    """An effect on the returns. gain: in log-likelihood over a constant share of losses; chance: (m,) of being lost; covariate:
    of a free form, whose name is that of the effect that comes nearest; else empty."""

    name: str
    gain: float
    score: float
    parameters: dict[str, float]
    std: dict[str, float]
    chance: FloatArray
    tried: tuple[tuple[str, float], ...] = ()
    covariate: str = ""


@dataclass(frozen=True)
class Losses:
    """lost: (m,); fit: (m,) pulses that may be looked at; plain: log-likelihood of those at one share of losses."""

    lost: BoolArray
    fit: BoolArray
    plain: float

    @classmethod
    def of(cls, lost: BoolArray, fit: BoolArray) -> Losses:
        """Of pulses (m,)."""
        share = np.full(int(fit.sum()), np.clip(lost[fit].mean(), 1e-9, 1 - 1e-9))
        return cls(lost, fit, _likelihood(lost[fit], share))

    def best(self, chance: Callable[[FloatArray, FloatArray], FloatArray], x: FloatArray, starts: list[FloatArray]) -> _Best:
        """The most likely values of a chance of being lost, which is a function of them and of what x (m,) holds."""
        seen, lost = x[self.fit], self.lost[self.fit]
        thin = slice(None, None, max(len(lost) // _MOST_PULSES, 1))
        first = starts[int(np.argmax([_likelihood(lost[thin], chance(start, seen[thin])) for start in starts]))]

        def cost(values: FloatArray) -> float:
            return -_likelihood(lost, chance(values, seen))

        found = minimize(cost, first, method="Nelder-Mead", options={"maxiter": 150, "xatol": 1e-3, "fatol": 0.05})
        return _Best(found.x, -float(found.fun) - self.plain, chance(found.x, x), cost)


@dataclass(frozen=True)
class _Best:
    """values at the top; gain over one share of losses; chance: (m,); cost: negative log-likelihood of values."""

    values: FloatArray
    gain: float
    chance: FloatArray
    cost: Callable[[FloatArray], float]


def find_missing(
    missing: ExpectedPulses, fit: BoolArray, early: int, points: int, intensity: FloatArray | None
) -> MissingFound | None:
    """The effect that the losses ask for, if any. fit: (m,) pulses that may be looked at; early: returns far before the surface,
    of `points`; intensity: (n,) or None.

    Losses come in clusters (shrubs, wet rock), so that a likelihood of independent pulses is far too sure: gains are divided by
    how much more the losses of whole patches scatter than independent ones would, under the best explanation itself.
    """
    lost = missing.lost
    losses = Losses.of(lost, fit)
    limit = _limit(losses, missing.covariates["log_power"])
    rain = _rain(losses, missing.covariates["range"], early, points)
    if intensity is not None and not _is_cut(intensity):
        limit = replace(limit, score=-np.inf)
    best, other = (limit, rain) if limit.score >= rain.score else (rain, limit)
    free = _free(losses, missing.covariates)
    by = decided().losses
    if free.score > by.free_ratio * max(best.score, 0.0) + by.free_margin and _strips_agree(missing, best, free, fit):
        best = free
    sureness = 1 / _clustering(lost[fit], best.chance[fit], missing.wall_xy[fit])
    best = replace(best, gain=best.gain * sureness, score=best.score * sureness)
    if best.score < decided().losses.least_gain:
        return None
    return replace(
        best,
        std={key: value / np.sqrt(sureness) for key, value in best.std.items()},
        tried=((best.name, best.score), (other.name, other.score)),
    )


def isolated(at: FloatArray, early: BoolArray) -> int:
    """How many returns come early from drops, which fall anywhere; what stands before the wall, or an edge of it, returns many
    pulses side by side, and then it is none."""
    patch, count = wall_blocks_by_points(at, _PULSES_PER_PATCH), int(early.sum())
    number = int(patch.max()) + 1
    anywhere = number * (1 - (1 - 1 / number) ** count)
    return count if len(np.unique(patch[early])) >= decided().losses.scattered * anywhere else 0


def _clustering(lost: BoolArray, chance: FloatArray, at: FloatArray) -> float:
    """Variance of the patches' losses over that of independent ones, at least 1."""
    patch = wall_blocks_by_points(at, _PULSES_PER_PATCH)
    left = np.bincount(patch, lost - chance)
    expected = np.bincount(patch, chance * (1 - chance))
    return float(max(np.sum(left**2) / np.sum(expected), 1.0))


def _strips_agree(missing: ExpectedPulses, known: MissingFound, free: MissingFound, fit: BoolArray) -> bool:
    """Whether losses by one angle are common to all strips of the other: a shrub before the wall takes the pulses of a few, as do
    lines that the scanner dropped. Each strip is asked what it gains by the losses of the others."""
    lost, across = missing.lost[fit], missing.covariates[_DIRECTIONS[free.covariate]][fit]
    strip, group = _equal_parts(across, _STRIPS), _equal_parts(missing.covariates[free.covariate], _BINS)[fit]
    sent, gone = (np.bincount(strip * _BINS + group, each, _STRIPS * _BINS).reshape(_STRIPS, _BINS) for each in (None, lost))
    others = (gone.sum(axis=0) - gone + 0.5) / (sent.sum(axis=0) - sent + 1.0)
    p, q = np.clip(known.chance[fit], 1e-9, 1 - 1e-9), others[strip, group]
    sums = np.bincount(strip, np.where(lost, np.log(q / p), np.log1p(-q) - np.log1p(-p)), _STRIPS)
    return float(sums.sum()) > decided().losses.agreement * np.sqrt(_STRIPS) * float(np.linalg.norm(sums))


def _equal_parts(values: FloatArray, count: int) -> NDArray[np.int64]:
    """(m,) which of `count` parts of as many values each a value is in."""
    return np.asarray(np.searchsorted(np.quantile(values, np.linspace(0, 1, count + 1)[1:-1]), values))


def _is_cut(intensity: FloatArray) -> bool:
    """Whether the recorded powers end abruptly, as under a limit, and do not thin out: by the spacing of the weakest ones.

    Below a cut the density falls from some value to none, so that the first percent of the powers takes twice as much of their
    range as the first half percent (0.5); the tail of a normal distribution of the logarithm gives 0.8.
    """
    ordered = np.sort(np.log(np.maximum(intensity, 1e-12)))
    low, middle, high = (float(ordered[int(share * (len(ordered) - 1))]) for share in (0.0005, 0.005, 0.01))
    return (middle - low) < decided().losses.abrupt * (high - low)


def _limit(losses: Losses, log_power: FloatArray) -> MissingFound:
    """P = p0 + (1 - p0) Phi((ln P_min - ln rho - ln(cos i / R^2)) / s): the albedo is unknown, log-normal."""

    def chance(values: FloatArray, x: FloatArray) -> FloatArray:
        base = expit(values[2])
        return np.asarray(base + (1 - base) * ndtr((values[0] - x) / np.exp(values[1])))

    starts = [
        np.array([level - spread, np.log(spread), logit(base)])
        for spread in (0.05, 0.2, 0.5)
        for level in np.quantile(log_power, [0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95])
        for base in (0.003, 0.02, 0.08)
    ]
    found = losses.best(chance, log_power, starts)
    value = float(np.exp(np.clip(found.values[0], -_LARGEST_LOG, _LARGEST_LOG)) * 0.5)
    std = {"minimum_power": value * float(np.exp(found.values[1]))}
    return MissingFound(DetectionLimit.tag(), found.gain, found.gain - 3.0, {"minimum_power": value}, std, found.chance)


def _rain(losses: Losses, range_m: FloatArray, early: int, points: int) -> MissingFound:
    """P = 1 - (1 - p0) exp(-2 beta R); early returns count as drops where they are more than a few."""

    def chance(values: FloatArray, x: FloatArray) -> FloatArray:
        return np.asarray(1 - (1 - expit(values[1])) * np.exp(-2 * np.exp(values[0]) * x))

    starts = [np.array([np.log(rate), logit(base)]) for rate in np.geomspace(1e-6, 0.05, 20) for base in (0.003, 0.01, 0.03, 0.1)]
    found = losses.best(chance, range_m, starts)
    share = min(early / max(float(losses.lost.sum()) + early, 1.0), 1.0)
    rate = max(float(np.exp(found.values[0])) / max(1 - share, 1e-3), 1e-6)
    drops = 10.0 * early if early > max(5, 1e-4 * points) else 0.0
    std = {"rate_per_m": rate * _log_error(found.cost, found.values), "early_share": float(np.sqrt(share / max(early, 1)))}
    gain, parameters = found.gain + drops, {"rate_per_m": rate, "early_share": share}
    return MissingFound(Precipitation.tag(), gain, gain - 2.0, parameters, std, found.chance)


def _log_error(cost: Callable[[FloatArray], float], top: FloatArray) -> float:
    """Standard deviation of the first of two values at the least cost, by the cost's curvature; 1 where that says nothing."""
    step = 0.05
    moves = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]])
    a, b, c, d, e, f = (cost(top + move) for move in moves)
    middle = cost(top)
    own, other = (a + b - 2 * middle) / step**2, (c + d - 2 * middle) / step**2
    both = (e + f - a - b - c - d + 2 * middle) / (2 * step**2)
    determinant = own * other - both**2
    return float(np.sqrt(other / determinant)) if determinant > 0 < other else 1.0


def _free(losses: Losses, covariates: dict[str, FloatArray]) -> MissingFound:
    """Losses free in each of some bins of one angle; their mean as a rate of precipitation."""
    found, lost, fit = [], losses.lost, losses.fit
    rate = max(-float(np.log1p(-min(float(lost.mean()), 0.999))) / (2 * float(np.mean(covariates["range"]))), 1e-6)
    for name in _DIRECTIONS:
        group = _equal_parts(covariates[name], _BINS)
        count = np.maximum(np.bincount(group[fit], minlength=_BINS), 1)
        chance = (np.bincount(group[fit], lost[fit], _BINS) / count)[group]
        gain = _likelihood(lost[fit], chance[fit]) - losses.plain
        parameters = {"rate_per_m": rate, "early_share": 0.0}
        found.append(MissingFound(Precipitation.tag(), gain, gain - _BINS, parameters, {}, chance, (), name))
    return max(found, key=lambda each: each.score)


def _likelihood(lost: BoolArray, chance: FloatArray) -> float:
    p = np.clip(chance, 1e-9, 1 - 1e-9)
    return float(np.sum(np.log(np.where(lost, p, 1 - p))))
