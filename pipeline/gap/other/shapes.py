"""Effects that show where the surface is not smooth: what was found, and when blocks all over the wall bear it out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.decisions import decided
from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect

_STRAY = 1e-3
_SLACK = 0.15
"""Share of what an effect adds by which its height on the reference may be off."""
_POINTS_PER_BLOCK = 100.0


@dataclass(frozen=True)
class ShapeFound:
    """An effect on the shape. effect: with its values; std: of the parameters; touched: (n,) points where it cannot be predicted
    to the noise."""

    effect: Effect
    std: dict[str, float]
    gain: float
    touched: BoolArray

    @property
    def name(self) -> str:
        """The catalogue's."""
        return self.effect.name


@dataclass(frozen=True)
class WallBlocks:
    """number: (n,) of the block of the wall in which each point lies."""

    number: NDArray[np.int64]

    @classmethod
    def over(cls, at: FloatArray) -> WallBlocks:
        """Of about a hundred points each; at: (n, 2)."""
        return cls(wall_blocks_by_points(at, _POINTS_PER_BLOCK))

    def sums(self, gains: FloatArray) -> FloatArray:
        """Gains (n,) by block."""
        return np.asarray(np.bincount(self.number, gains))

    def tested(self, gains: FloatArray, least_sigmas: float | None = None, *, by_signs: bool = False) -> float | None:
        """Total of gains (n,), None where they do not convince: blocks all over the wall have to agree, by their sums, or by the
        signs of these where few of them hold most of the points."""
        by = decided().shapes
        total, sums = float(gains.sum()), self.sums(np.clip(gains, -by.most_of_a_point, by.most_of_a_point))
        sigmas = float(sums.sum()) / max(float(np.linalg.norm(sums)), 1e-12)
        if by_signs:
            signs = np.sign(sums[sums != 0])
            sigmas = max(sigmas, float(signs.sum()) / max(float(np.linalg.norm(signs)), 1.0))
        if total < by.least_gain or sigmas < (by.block_sigmas if least_sigmas is None else least_sigmas):
            return None
        return total

    def std(self, gains: Callable[[float], FloatArray], value: float, width: float | None = None) -> float:
        """Standard deviation of a value at the top of its gains, by how the blocks' slopes scatter (sandwich).

        width: on either side, over which slopes are taken; a twentieth of the value where None.
        """
        width = 0.05 * value if width is None else width
        low, middle, high = (self.sums(gains(each)) for each in (value - width, value, value + width))
        slopes, curvature = (high - low) / (2 * width), float((high - 2 * middle + low).sum()) / width**2
        return float(np.linalg.norm(slopes)) / max(-curvature, 1e-12)


def log_density(rough: FloatArray, moved: FloatArray, sigma: FloatArray) -> FloatArray:
    """(n,) log density of residuals that an effect moves by `moved`: Gaussian, with some that may lie anywhere."""
    spread = np.hypot(sigma, _SLACK * moved)
    return np.asarray(np.log(np.exp(-0.5 * ((rough - moved) / spread) ** 2) / spread + _STRAY))


def refined(gains: Callable[[float], FloatArray], values: list[float], factors: tuple[float, ...]) -> float:
    """The value of the largest total gain: on a grid, on finer ones around the best, at the top of a parabola through three."""
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
