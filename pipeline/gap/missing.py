"""Which effects explain the returns that are missing: losses that grow with range, or that fall on weak echoes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from pipeline.gap.cells import patches
from pipeline.gap.residuals import BoolArray, Missing
from scene.mesh import FloatArray

_LEAST_GAIN = 9.0
_PULSES_PER_PATCH = 60.0
_ABRUPT = 0.7


@dataclass(frozen=True)
class MissingFound:
    """An effect on the returns. gain: in log-likelihood over a constant share of losses; chance: (m,) of being lost."""

    name: str
    gain: float
    score: float
    parameters: dict[str, float]
    std: dict[str, float]
    chance: FloatArray
    tried: tuple[tuple[str, float], ...]


def find_missing(missing: Missing, early: int, points: int, intensity: FloatArray | None) -> MissingFound | None:
    """The effect that the losses ask for, if any. early: returns far before the surface, of `points`; intensity: (n,) or None.

    Losses come in clusters (shrubs, wet rock), so that a likelihood of independent pulses is far too sure: gains are divided by
    how much more the losses of whole patches scatter than independent ones would, under the best explanation itself.
    """
    lost = missing.lost
    share = float(np.clip(lost.mean(), 1e-9, 1 - 1e-9))
    plain = float(lost.sum() * np.log(share) + (~lost).sum() * np.log1p(-share))
    limit, rain = (
        _limit(lost, missing.covariates["log_power"], plain),
        _rain(lost, missing.covariates["range"], plain, early, points),
    )
    if intensity is not None and not _is_cut(intensity):
        limit = replace(limit, score=-np.inf)
    best, other = (limit, rain) if limit.score >= rain.score else (rain, limit)
    sureness = 1 / _clustering(lost, best.chance, missing.at)
    best = replace(best, gain=best.gain * sureness, score=best.score * sureness)
    if best.score < _LEAST_GAIN:
        return None
    return MissingFound(
        best.name,
        best.gain,
        best.score,
        best.parameters,
        {key: value / np.sqrt(sureness) for key, value in best.std.items()},
        best.chance,
        ((best.name, best.score), (other.name, other.score)),
    )


def _clustering(lost: BoolArray, chance: FloatArray, at: FloatArray) -> float:
    """Variance of the patches' losses over that of independent ones, at least 1."""
    patch = patches(at, _PULSES_PER_PATCH)
    left = np.bincount(patch, lost - chance)
    expected = np.bincount(patch, chance * (1 - chance))
    return float(max(np.sum(left**2) / np.sum(expected), 1.0))


def _is_cut(intensity: FloatArray) -> bool:
    """Whether the recorded powers end abruptly, as under a limit, and do not thin out: by the spacing of the weakest ones.

    Below a cut the density falls from some value to none, so that the first percent of the powers takes twice as much of their
    range as the first half percent (0.5); the tail of a normal distribution of the logarithm gives 0.8.
    """
    ordered = np.sort(np.log(np.maximum(intensity, 1e-12)))
    low, middle, high = (float(ordered[int(share * (len(ordered) - 1))]) for share in (0.0005, 0.005, 0.01))
    return (middle - low) < _ABRUPT * (high - low)


def _limit(lost: BoolArray, log_power: FloatArray, plain: float) -> MissingFound:
    """P = p0 + (1 - p0) Phi((ln P_min - ln rho - ln(cos i / R^2)) / s): the albedo is unknown, log-normal."""
    best = (-np.inf, 0.0, 0.0, 0.0)
    for spread in (0.05, 0.2, 0.4, 0.7):
        for level in np.quantile(log_power, [0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4]) - spread:
            steep = ndtr((level - log_power) / spread)
            for base in (1e-4, 0.003, 0.01, 0.02, 0.03, 0.05, 0.1):
                best = max(best, (_likelihood(lost, base + (1 - base) * steep) - plain, float(level), spread, base))
    gain, level, spread, base = best
    chance = base + (1 - base) * ndtr((level - log_power) / spread)
    value = float(np.exp(level) * 0.5)
    return MissingFound(
        "detection_limit", gain, gain - 3.0, {"minimum_power": value}, {"minimum_power": value * spread}, chance, ()
    )


def _rain(lost: BoolArray, range_m: FloatArray, plain: float, early: int, points: int) -> MissingFound:
    """P = 1 - (1 - p0) exp(-2 beta R); early returns count as drops where they are more than a few."""
    rates = np.concatenate([[0.0], np.geomspace(1e-6, 0.05, 40)])
    bases = (0.0, 0.003, 0.006, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1)
    gains = np.array(
        [[_likelihood(lost, 1 - (1 - base) * np.exp(-2 * rate * range_m)) - plain for base in bases] for rate in rates]
    )
    drops = 10.0 * early if early > max(5, 1e-4 * points) else 0.0
    profile = gains.max(axis=1)
    rate = float(rates[int(np.argmax(profile))])
    base = bases[int(np.argmax(gains[int(np.argmax(profile))]))]
    chance = 1 - (1 - base) * np.exp(-2 * rate * range_m)
    near = rates[profile > profile.max() - 0.5]
    share = min(early / max(float(lost.sum()) + early, 1.0), 1.0)
    parameters = {"rate_per_m": max(rate, 1e-6), "early_share": share}
    std = {"rate_per_m": float(max(np.ptp(near) / 2, 0.1 * rate)), "early_share": float(np.sqrt(share / max(early, 1)))}
    gain = float(profile.max()) + drops
    return MissingFound("precipitation", gain, gain - 2.0, parameters, std, chance, ())


def _likelihood(lost: BoolArray, chance: FloatArray) -> float:
    p = np.clip(chance, 1e-9, 1 - 1e-9)
    return float(np.sum(np.log(np.where(lost, p, 1 - p))))
