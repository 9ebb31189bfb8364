"""Find heavy tails of the residuals: more outliers than normal noise makes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.residuals.residuals import BoolArray
from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray

_CLIP_SIGMAS = 12.0
"""Standard deviations at which outliers are clipped."""


@dataclass(frozen=True)
class HeavyTails:
    """Outliers among the residuals in excess of those that normally distributed noise makes.

    Attributes
    ----------
    share : share of all residuals beyond the threshold `variance.tail_sigmas`, in standard deviations of the core.
    sigma : standard deviation of the noise to be added to that of the core to explain the scatter of all residuals, in
        standard deviations of the core.
    gain : log-likelihood ratio of a mixture, in which this share of the residuals has larger noise, against normal noise.
    uniform : whether outliers lie all over the wall, as an instrument's own do. Edges, plants and moved rock leave them in
        parts of it.
    """

    share: float
    sigma: float
    gain: float
    uniform: bool

    @property
    def note(self) -> str:
        """Description of the excess outliers of the residuals, as a sentence for the report."""
        limit = thresholds().variance.tail_sigmas
        where = "all over the wall" if self.uniform else "in parts of the wall, as at edges, plants or moved rock"
        return f"{100 * self.share:.2g} % of the points lie beyond {limit:g} standard deviations, {where}"


def find_heavy_tails(z: FloatArray, block: NDArray[np.int64]) -> HeavyTails | None:
    """Find outliers in excess of those that normal noise and small faults of the reference make; None if there are none.

    Parameters
    ----------
    z : (n,) residuals over the standard deviation of their core: the one that the model with all named effects predicts, times
        the ratio of observed to predicted noise.
    block : (n,) number of the wall block (a square part of the wall) of each point, to see whether outliers lie all over the
        wall.
    """
    by = thresholds().variance
    outlying = np.abs(z) > by.tail_sigmas
    share = float(outlying.mean())
    if share < by.most_tail_share:
        return None
    square = np.minimum(z**2, _CLIP_SIGMAS**2)
    tail_variance = max(float(square[outlying].mean()), 1.0)
    mixed = np.log(1 - share + share / np.sqrt(tail_variance) * np.exp(0.5 * square * (1 - 1 / tail_variance)))
    sigma = float(np.sqrt(max(float(square.mean()) - 1, 0.0)))
    return HeavyTails(share, sigma, float(mixed.sum()), _unevenness(outlying, block) < by.most_tail_unevenness)


def _unevenness(outlying: BoolArray, block: NDArray[np.int64]) -> float:
    """Standard deviation over mean of the blocks' shares of outliers, beyond chance."""
    _, number = np.unique(block, return_inverse=True)
    expected = np.bincount(number) * outlying.mean()
    beyond_chance = np.sum((np.bincount(number, outlying) - expected) ** 2 - expected * (1 - outlying.mean()))
    return float(np.sqrt(max(float(beyond_chance), 0.0) / np.sum(expected**2)))
