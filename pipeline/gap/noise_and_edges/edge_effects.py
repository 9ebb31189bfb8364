"""Edge effects, which show at depth steps only: their form, and the test that wall blocks agree on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.wall_blocks import agreement, wall_blocks_by_points
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
    effect : the effect with its estimated parameters.
    std : standard deviations of its parameters, by parameter name.
    gain : log-likelihood ratio of the models with and without it.
    touched : (n,) points whose shift by the effect cannot be predicted as precisely as the noise. Other fits leave them out.
    """

    effect: Effect
    std: dict[str, float]
    gain: float
    touched: BoolArray

    @property
    def name(self) -> str:
        """Name of the edge effect in the catalogue of sensor effects, such as "edge_fattening"."""
        return self.effect.name


def edge_blocks(at: FloatArray) -> NDArray[np.int64]:
    """Divide the wall into squares (wall blocks) of about a hundred points, and return the number of that of each point (n,).

    Residuals are correlated within such a block, so blocks and not points count as independent in tests of edge effects.

    at: (n, 2) positions of the points, x along the wall and y up, wall frame, m.
    """
    return wall_blocks_by_points(at, _POINTS_PER_BLOCK)


def agreed_gain(
    gains: FloatArray, block: NDArray[np.int64], least_sigmas: float | None = None, *, by_signs: bool = False
) -> float | None:
    """Test an edge effect: return its log-likelihood ratio if it is large enough and the wall blocks agree, else None.

    Parameters
    ----------
    gains : (n,) log-likelihood ratio of each point: model with the effect against model without it.
    block : (n,) number of each point's wall block, from `edge_blocks`.
    least_sigmas : smallest `agreement` of the wall blocks that is accepted; None: the threshold `edges.block_sigmas`.
    by_signs : whether agreement of the signs alone is enough, for effects of which a few wall blocks hold most of the points.
    """
    by, most = thresholds().edges, thresholds().mean.class_margin
    total, sums = float(gains.sum()), np.bincount(block, np.clip(gains, -most, most))
    sigmas = max(agreement(sums), agreement(np.sign(sums))) if by_signs else agreement(sums)
    if total < by.least_gain or sigmas < (by.block_sigmas if least_sigmas is None else least_sigmas):
        return None
    return total


def block_std(gains: Callable[[float], FloatArray], block: NDArray[np.int64], value: float, width: float | None = None) -> float:
    """Return the standard deviation of an edge effect's parameter at its maximum-likelihood value.

    It comes from the scatter between wall blocks of the derivative of the log-likelihood (sandwich estimator), so points in a
    wall block may be correlated.

    Parameters
    ----------
    gains : function from the parameter's value to the (n,) log-likelihood ratios of the points.
    block : (n,) number of each point's wall block, from `edge_blocks`.
    value : maximum-likelihood value of the parameter.
    width : half-width of the finite differences, unit of the parameter; None: a twentieth of the value.
    """
    width = 0.05 * value if width is None else width
    low, middle, high = (np.bincount(block, gains(each)) for each in (value - width, value, value + width))
    slopes, curvature = (high - low) / (2 * width), float((high - 2 * middle + low).sum()) / width**2
    return float(np.linalg.norm(slopes)) / max(-curvature, 1e-12)


def log_density(registered_residuals: FloatArray, shift: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the log density of residuals that an effect shifts: a Gaussian plus a small constant for outliers.

    Parameters
    ----------
    registered_residuals : (n,) residuals after a robust pose fit, m (ranges) or px (disparities).
    shift : (n,) predicted shift of each residual by the effect, same unit; its uncertainty of 15 % is added to the noise.
    sigma : (n,) standard deviations of the noise, same unit.

    Returns
    -------
    FloatArray : (n,) log densities, up to a constant.
    """
    sigma_with_height = np.hypot(sigma, _STEP_HEIGHT_UNCERTAINTY * shift)
    return np.asarray(
        np.log(np.exp(-0.5 * ((registered_residuals - shift) / sigma_with_height) ** 2) / sigma_with_height + _OUTLIER_DENSITY)
    )


def maximise_gain(gains: Callable[[float], FloatArray], values: list[float], factors: tuple[float, ...]) -> float:
    """Find the maximum-likelihood value of an edge effect's positive parameter, such as a width.

    The search tries given values, then finer geometric grids around the best one, and ends with a parabola.

    Parameters
    ----------
    gains : function from the parameter's value to the (n,) log-likelihood ratios of the points.
    values : values to try first.
    factors : ratio of neighbouring values in each finer grid, coarsest first.

    Returns
    -------
    float : the value with the largest total log-likelihood ratio.
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
    return float(best * factors[-1] ** step)
