"""Effects of both sensors in this generator: how they act, how their size is set, and which parameters are scored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .surface import Array

Parameters = dict[str, Any]


def nothing_else(rng: np.random.Generator, shot: Any) -> Parameters:
    """No further parameters."""
    return {}


@dataclass(frozen=True)
class Effect:
    """One deviation from the model.

    Attributes
    ----------
    stage : How `act(parameters, shot)` is used (see the sensors' modules).
    sizes : Parameters that carry the size, at a typical value. They are scaled together to the drawn strength, at most to `most`
        times the
        typical value (a few times the largest size of EFFECTS.md, beyond which no instrument would leave the factory).
    others : Draws the remaining parameters.
    scored : Parameters whose interval is compared with the truth.
    """

    stage: str
    act: Callable[..., Any]
    sizes: dict[str, float]
    others: Callable[[np.random.Generator, Any], Parameters] = nothing_else
    most: float = 60.0
    least: float = 1e-3
    scored: tuple[str, ...] = field(default=())

    def draw(self, rng: np.random.Generator, shot: Any) -> Parameters:
        """Draw parameters at the typical size, with random signs for sizes that may have either."""
        either = {key for key in self.sizes if self.stage in SIGNED and key not in UNSIGNED}
        signs = {key: float(rng.choice([-1.0, 1.0])) if key in either else 1.0 for key in self.sizes}
        return {**self.others(rng, shot), **{key: signs[key] * size * rng.uniform(0.7, 1.4) for key, size in self.sizes.items()}}

    def scaled(self, parameters: Parameters, factor: float) -> Parameters:
        """Return the parameters with the sizes `factor` times as large."""
        return {key: value * factor if key in self.sizes else value for key, value in parameters.items()}


SIGNED = ("aim", "range", "camera")
UNSIGNED = ("amplitude_m", "amplitude_rad", "amplitude_px")


def solve_size(effect: Effect, parameters: Parameters, strength: Callable[[Parameters], float], wanted: float) -> Parameters:
    """Scales the sizes until `strength` is `wanted`, within the effect's bounds (bisection of the factor's logarithm)."""
    low, high = np.log(effect.least), np.log(effect.most)
    for _ in range(14):
        middle = 0.5 * (low + high)
        if strength(effect.scaled(parameters, float(np.exp(middle)))) < wanted:
            low = middle
        else:
            high = middle
    return effect.scaled(parameters, float(np.exp(0.5 * (low + high))))


@dataclass(frozen=True)
class Whitening:
    """Weights displacements by the known noise, so that a length is a signal-to-noise ratio.

    In each patch, the mean has the weight 1 / (error + noise / n), and deviations within the patch 1 / noise.

    Attributes
    ----------
    variance : (n,) variance of a point's noise.
    patch : (n,) number of the patch over which the reference's error is constant.
    patch_variance : (n,) variance of that error in the observable.
    pose : (n, 6) effect of the six pose parameters.
    """

    variance: Array
    patch: np.ndarray[Any, Any]
    patch_variance: Array
    pose: Array

    def white(self, columns: Array) -> Array:
        """Transform (n, k) to (n + patches, k): deviations within patches, then the patches' means."""
        weight = 1 / self.variance
        total = np.maximum(np.bincount(self.patch, weight), 1e-12)
        error = np.bincount(self.patch, weight * self.patch_variance) / total
        means = np.stack([np.bincount(self.patch, weight * each) / total for each in columns.T], axis=1)
        within = (columns - means[self.patch]) * np.sqrt(weight)[:, None]
        return np.concatenate([within, means / np.sqrt(error + 1 / total)[:, None]])

    def strength(self, shift: Array, other: Array | None = None) -> float:
        """Return the signal-to-noise ratio of a shift (n,) after fitting the pose and `other` (n, k).

        The square of one point counts 9 at most.
        """
        nuisance = self.white(self.pose if other is None else np.concatenate([self.pose, other], axis=1))
        wanted = self.white(shift[:, None])[:, 0]
        scale = np.maximum(np.linalg.norm(nuisance, axis=0), 1e-30)
        rest = wanted - nuisance @ (np.linalg.lstsq(nuisance / scale, wanted, rcond=1e-9)[0] / scale)
        many = len(shift)
        return float(np.sqrt(np.minimum(rest[:many] ** 2, 9.0).sum() + (rest[many:] ** 2).sum()))


def alternatives(effect: Effect, rng: np.random.Generator, shot: Any) -> list[Parameters]:
    """Return parameters that span the effect linearly: each size alone, each at two phases."""
    drawn = effect.draw(rng, shot)
    only = [{**drawn, **{key: drawn[key] * (key == one) for key in effect.sizes}} for one in effect.sizes]
    return [{**each, **({"phase_rad": p} if "phase_rad" in each else {})} for each in only for p in (0.0, np.pi / 2)]


def spread_strength(added: Array, variance: Array) -> float:
    """Return the root of twice the information of (n,) added variance relative to the known variance: sqrt(2 sum KL)."""
    ratio = np.clip((variance + added) / variance, 1.0, 50.0)
    return float(np.sqrt(np.sum(ratio - 1 - np.log(ratio))))


def loss_strength(lost: Array, base: float) -> float:
    """Return how strongly losses stand out: the root of twice their information.

    lost: (n,) probability of a loss by the effect; base: share that is lost anywhere.
    """
    p = np.clip(base + (1 - base) * lost, 1e-6, 1 - 1e-6)
    return float(np.sqrt(2 * np.sum(p * np.log(p / base) + (1 - p) * np.log((1 - p) / (1 - base)))))
