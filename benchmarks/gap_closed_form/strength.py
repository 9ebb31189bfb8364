"""Compute how strongly an effect stands out, and from which other effects.

The strength is a distance between predictions after the pose fit.

For a mean effect it is the Mahalanobis distance, with white noise within cells and, between cells, also the reference's error,
correlated over metres. For an effect on variance or losses it is the square root of twice the Kullback-Leibler divergence, summed
over the measurements, which is the same for small effects. The distance to "nothing" is the signal-to-noise ratio; that to an
effect of another class at its best parameters is signal-to-noise ratio x sin(angle between the signatures).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.gap_closed_form.casting import Array

Families = Mapping[str, Sequence[Array]]
"""Candidate effects by name; each variant is a design (n, k)."""
_CELLS = 450
_MOST_POINTS = 9000
_LARGEST = 1e4
_ALIKE = 0.1
_TARGETS = (2.0, 120.0)


@dataclass(frozen=True)
class Strength:
    """Strength of an effect.

    Attributes
    ----------
    snr : Signal-to-noise ratio.
    nearest : The nearest effect of another class.
    distance : Distance to it, snr x sin(angle).
    alike : Effects whose signature differs by less than a tenth (sin < 0.1), which form one class with this one.
    """

    snr: float
    nearest: str
    distance: float
    alike: tuple[str, ...] = ()

    @classmethod
    def among(cls, snr: float, others: Mapping[str, float]) -> Strength:
        """others: distance to each other effect."""
        alike = tuple(sorted(name for name, distance in others.items() if distance < _ALIKE * snr))
        apart = {name: distance for name, distance in others.items() if name not in alike}
        nearest = min(apart, key=lambda name: apart[name], default="")
        return cls(snr, nearest, apart.get(nearest, snr), alike)

    def to_dict(self) -> dict[str, Any]:
        """For the truth's file."""
        return {
            "snr": min(self.snr, _LARGEST),
            "nearest": self.nearest,
            "snr_sin_angle": min(self.distance, _LARGEST),
            "alike": self.alike,
        }


class Whitener:
    """Transforms columns over points to columns with independent unit errors.

    sigma: (n,) white noise; at: (n, 2) m; features: (n, f) shapes whose sum with independent normal weights is the correlated
    error.
    """

    def __init__(self, sigma: Array, at: Array, features: Array) -> None:
        stride = max(len(sigma) // _MOST_POINTS, 1)
        self.rows = slice(None, None, stride)
        self._scale = np.sqrt(len(sigma) / len(sigma[self.rows]))
        self._sigma = sigma[self.rows]
        side = np.sqrt(np.prod(np.ptp(at, axis=0)) / _CELLS)
        corner = np.floor((at[self.rows] - at.min(axis=0)) / side).astype(int)
        self._cell = np.unique(corner[:, 0] * 100_000 + corner[:, 1], return_inverse=True)[1].ravel()
        self._weight = np.bincount(self._cell, 1 / self._sigma**2)
        mean = self._means(features[self.rows])
        white = np.diag(1 / self._weight) / self._scale**2
        self._root = np.linalg.cholesky(white + mean @ mean.T)

    def _means(self, columns: Array) -> Array:
        weighted = columns / self._sigma[:, None] ** 2
        total = np.empty((len(self._weight), columns.shape[1]))
        for index, column in enumerate(weighted.T):
            total[:, index] = np.bincount(self._cell, column, len(self._weight))
        return total / self._weight[:, None]

    def __call__(self, columns: Array) -> Array:
        """(n, k) or (n,) to (n' + cells, k)."""
        chosen = columns.reshape(len(columns), -1)[self.rows]
        mean = self._means(chosen)
        within = (chosen - mean[self._cell]) / self._sigma[:, None] * self._scale
        return np.concatenate([within, np.linalg.solve(self._root, mean)])


def basis(columns: Array) -> Array:
    """Return orthonormal columns that span the same space, without redundant ones."""
    size = np.linalg.norm(columns, axis=0)
    q, r = np.linalg.qr(columns / np.where(size > 0, size, 1.0))
    return q[:, np.abs(np.diag(r)) > 1e-7]


def mean_strength(name: str, signature: Array, base: Array, families: Families, whiten: Whitener) -> Strength:
    """Return the strength of a mean effect.

    Parameters
    ----------
    name : Name of the effect, which is not compared with itself.
    signature : (n,) its range or disparity errors.
    base : (n, b) columns to fit first, such as the pose.
    families : Columns of the other effects.
    whiten : Transforms columns to white noise.
    """
    fixed = basis(whiten(base))
    clean = _without(fixed, whiten(signature))[:, 0]
    snr = float(np.linalg.norm(clean))
    others = {other: _nearest(clean, fixed, variants, whiten) for other, variants in families.items() if other != name}
    return Strength.among(snr, others)


def _without(fixed: Array, columns: Array) -> Array:
    return columns - fixed @ (fixed.T @ columns)


def _nearest(clean: Array, fixed: Array, variants: Sequence[Array], whiten: Whitener) -> float:
    widths = [variant.shape[1] for variant in variants]
    columns = _without(fixed, whiten(np.concatenate(list(variants), axis=1)))
    gram, cross, start, best = columns.T @ columns, columns.T @ clean, 0, 0.0
    for width in widths:
        part = slice(start, start + width)
        matrix = gram[part, part]
        best = max(best, float(cross[part] @ np.linalg.pinv(matrix, rcond=1e-9, hermitian=True) @ cross[part]))
        start += width
    return float(np.sqrt(max(clean @ clean - best, 0.0)))


def spread_distance(true: Array, assumed: Array) -> float:
    """Return the distance between normal errors with variances (n,)."""
    ratio = true / assumed
    return float(np.sqrt(max(np.sum(ratio - 1 - np.log(ratio)), 0.0)))


def spread_strength(name: str, added: Array, variance: Array, forms: Mapping[str, Sequence[Array]]) -> Strength:
    """Return the strength of an effect that adds a variance (n,) to the model's.

    forms: variances of the other effects, which are scaled to come nearest.
    """
    true = variance + added
    scales = np.concatenate([[0.0], np.geomspace(1e-3, 30, 60)])
    others = {
        other: min(
            spread_distance(true, variance + scale * added.mean() / form.mean() * form) for form in several for scale in scales
        )
        for other, several in forms.items()
        if other != name
    }
    snr = spread_distance(true, variance)
    return Strength.among(snr, others)


def loss_distance(true: Array, assumed: Array) -> float:
    """Return the distance between probabilities of loss (n,)."""
    p, q = np.clip(true, 1e-6, 1 - 1e-6), np.clip(assumed, 1e-6, 1 - 1e-6)
    return float(np.sqrt(max(2 * np.sum(p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))), 0.0)))


@dataclass(frozen=True)
class Target:
    """Wanted strength of an effect: its signal-to-noise ratio, or its distance from the nearest other effect."""

    value: float
    own: bool

    @classmethod
    def draw(cls, random: np.random.Generator) -> Target:
        """Draw a strength from below the detection limit to far above it."""
        return cls(float(np.exp(random.uniform(*np.log(_TARGETS)))), bool(random.uniform() < 0.5))

    def of(self, strength: Strength) -> float:
        """Return the figure that must reach the value."""
        return strength.distance if self.own else strength.snr


def scaled(snr_of: Callable[[float], float], target: float, most: float) -> float:
    """Return the factor, at most `most`, at which a growing strength reaches its target, to a percent."""
    low, high = most * 1e-6, most
    if snr_of(high) <= target:
        return most
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if snr_of(middle) < target else (low, middle)
        if high < 1.01 * low:
            break
    return float(np.sqrt(low * high))
