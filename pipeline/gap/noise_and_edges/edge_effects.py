"""Edge effects, which show at depth steps only: their form, and the test that wall blocks agree on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect

_OUTLIER_DENSITY = 1e-3
"""Density of outliers, which may lie anywhere, beside the Gaussian."""
_STEP_HEIGHT_UNCERTAINTY = 0.15
"""Relative uncertainty of an effect's shift, because the reference does not show every step exactly."""
_POINTS_PER_BLOCK = 100.0


@dataclass(frozen=True)
class EdgeEffect:
    """An effect at depth steps that was found in the residuals, such as edge fattening or a wide laser beam.

    Attributes
    ----------
    effect : the effect of the catalogue with its estimated values.
    std : standard deviations of its parameters, by key.
    gain : log-likelihood ratio of the models with and without it.
    touched : (n,) true for points that it moves by an amount that cannot be predicted as well as the noise allows.
    """

    effect: Effect
    std: dict[str, float]
    gain: float
    touched: BoolArray

    @property
    def name(self) -> str:
        """Name of the effect in the catalogue."""
        return self.effect.name


@dataclass(frozen=True)
class WallBlocks:
    """Blocks of the wall with about a hundred points each. An effect is accepted only if they agree on it.

    Residuals are correlated within a block, so blocks and not points count as independent.

    Attributes
    ----------
    number : (n,) number of the block in which each point lies.
    """

    number: NDArray[np.int64]

    @classmethod
    def over(cls, at: FloatArray) -> WallBlocks:
        """Divide the wall into blocks, given the (n, 2) positions of the points in the wall frame, m."""
        return cls(wall_blocks_by_points(at, _POINTS_PER_BLOCK))

    def sums(self, gains: FloatArray) -> FloatArray:
        """Sum the log-likelihood ratios (n,) of the points over each block; return (b,) sums for b blocks."""
        return np.asarray(np.bincount(self.number, gains))

    def total_if_agreed(self, gains: FloatArray, least_sigmas: float | None = None, *, by_signs: bool = False) -> float | None:
        """Return the total log-likelihood ratio of an effect if it is large enough and the wall blocks agree on it, else None.

        Agreement is the sum of the blocks' ratios over the root of the sum of their squares, like a number of standard
        deviations.

        Parameters
        ----------
        gains : (n,) log-likelihood ratio of each point.
        least_sigmas : smallest agreement that is accepted; None: the threshold `edges.block_sigmas`.
        by_signs : whether agreement of the signs alone is enough, for effects of which a few blocks hold most of the points.
        """
        by = thresholds().edges
        total, sums = float(gains.sum()), self.sums(np.clip(gains, -by.most_gain_of_a_point, by.most_gain_of_a_point))
        sigmas = float(sums.sum()) / max(float(np.linalg.norm(sums)), 1e-12)
        if by_signs:
            signs = np.sign(sums[sums != 0])
            sigmas = max(sigmas, float(signs.sum()) / max(float(np.linalg.norm(signs)), 1.0))
        if total < by.least_gain or sigmas < (by.block_sigmas if least_sigmas is None else least_sigmas):
            return None
        return total

    def std(self, gains: Callable[[float], FloatArray], value: float, width: float | None = None) -> float:
        """Return the standard deviation of a parameter at its maximum-likelihood value.

        It is computed from the scatter of the blocks' derivatives (sandwich estimator), which is valid if points in a block are
        correlated.

        Parameters
        ----------
        gains : function from the parameter's value to the (n,) log-likelihood ratios of the points.
        value : maximum-likelihood value of the parameter.
        width : half-width of the finite differences, unit of the parameter; None: a twentieth of the value.
        """
        width = 0.05 * value if width is None else width
        low, middle, high = (self.sums(gains(each)) for each in (value - width, value, value + width))
        slopes, curvature = (high - low) / (2 * width), float((high - 2 * middle + low).sum()) / width**2
        return float(np.linalg.norm(slopes)) / max(-curvature, 1e-12)


def log_density(registered_residuals: FloatArray, shift: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the log density of residuals that an effect shifts: a Gaussian with a constant floor for outliers.

    Parameters
    ----------
    registered_residuals : (n,) residuals after a robust pose fit, in the unit of the observable.
    shift : (n,) shift of each point by the effect, same unit; it counts as uncertain by 15 %.
    sigma : (n,) standard deviations, same unit.

    Returns
    -------
    (n,) log densities, up to a constant.
    """
    sigma_with_height = np.hypot(sigma, _STEP_HEIGHT_UNCERTAINTY * shift)
    return np.asarray(
        np.log(np.exp(-0.5 * ((registered_residuals - shift) / sigma_with_height) ** 2) / sigma_with_height + _OUTLIER_DENSITY)
    )


def maximise_gain(gains: Callable[[float], FloatArray], values: list[float], factors: tuple[float, ...]) -> float:
    """Find the value of a positive parameter at which the total log-likelihood ratio is largest.

    The search tries a grid, then finer geometric grids around the best value, and ends with a parabola.

    Parameters
    ----------
    gains : function from the parameter's value to the (n,) log-likelihood ratios of the points.
    values : values of the first grid.
    factors : ratio of neighbouring values in each finer grid, coarsest first.
    """
    best = max(values, key=lambda each: float(gains(each).sum()))
    step = 0.0
    for factor in factors:
        tried = [float(gains(best * factor**power).sum()) for power in range(-4, 5)]
        top = int(np.argmax(tried[1:-1])) + 1
        low, middle, high = tried[top - 1 : top + 2]
        curvature = low - 2 * middle + high
        step = float(np.clip(0.5 * (low - high) / curvature, -1.0, 1.0)) if curvature < 0 else 0.0
        best *= factor ** (top - 4)
    return float(best * factors[-1] ** step) if factors else best
