"""What may explain a disagreement: an effect of the catalogue, or a free form of one covariate, as columns of a design."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from scene.mesh import FloatArray

_KNOTS = 5


@dataclass(frozen=True)
class Wave:
    """A searched sine: columns factor * sin, factor * cos of 2 pi x / period. key: the parameter that holds the period."""

    key: str
    factor: FloatArray
    x: FloatArray

    def columns(self, period: float) -> FloatArray:
        """(n, 2) the two columns at another period."""
        angle = 2 * np.pi / period * self.x
        return self.factor[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One explanation. columns: (n, k) observable per unit of each coefficient; parameters: coefficients to the effect's values.

    names: the parameters that the coefficients stand for; scales: parameter per coefficient where they are proportional; fixed:
    searched or chosen values that belong to this variant, such as a period or the camera; errors: standard deviations of those.
    """

    name: str
    columns: FloatArray
    parameters: Callable[[FloatArray], dict[str, float]]
    names: tuple[str, ...]
    scales: tuple[float, ...]
    fixed: Mapping[str, float | str] = field(default_factory=dict)
    empirical: bool = False
    wave: Wave | None = None
    errors: Mapping[str, float] = field(default_factory=dict)


def amplitude_and_phase(values: FloatArray, amplitude: str) -> dict[str, float]:
    """a sin x + b cos x as amplitude and phase."""
    return {amplitude: float(np.hypot(*values)), "phase_rad": float(np.arctan2(values[1], values[0]))}


def searched(name: str, amplitude: str, wave: Wave, period: float, **fixed: float | str) -> Candidate:
    """A sine of one of the periods that are tried."""
    values: dict[str, float | str] = {**fixed, wave.key: period}
    return Candidate(
        name,
        wave.columns(period),
        lambda c: amplitude_and_phase(c, amplitude),
        (amplitude, "phase_rad"),
        (1.0, 1.0),
        values,
        wave=wave,
    )


def free_form(covariate: str, values: FloatArray) -> Candidate:
    """A smooth function of one covariate: truncated-power cubic with knots at its quantiles, standardised."""
    spread = float(values.std()) or 1.0
    x = (values - values.mean()) / spread
    knots = np.quantile(x, np.linspace(0, 1, _KNOTS)[1:-1])
    columns = [x, x**2, x**3, *(np.maximum(x - knot, 0) ** 3 for knot in knots)]
    matrix = np.stack(columns, axis=1)
    matrix = matrix / np.maximum(matrix.std(axis=0), 1e-12)
    names = tuple(f"c{index}" for index in range(matrix.shape[1]))
    return Candidate(
        covariate, matrix, lambda c: dict(zip(names, map(float, c), strict=True)), names, (1.0,) * len(names), empirical=True
    )
