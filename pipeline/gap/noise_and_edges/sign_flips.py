"""Test noise terms against a null distribution in which the signs of the wall blocks' scores are flipped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

DRAWS = 1999
"""Number of sign flips of the null distribution."""


def null_p_value(squares: FloatArray, shapes: list[FloatArray], block: NDArray[np.int64], random: KeyedRandom) -> float:
    """Test whether any candidate noise effect explains that residuals vary more than predicted, and return the p-value.

    A candidate's score is large if deviations are larger where it adds more variance. The test statistic is the largest
    standardised score over the candidates, which corrects for their number. Its null distribution comes from random sign flips
    of the scores of whole wall blocks (squares of the wall).

    Parameters
    ----------
    squares : (n,) squared deviations of the residuals, over their predicted variance.
    shapes : for each candidate effect the (n,) variance that it adds at each point, divided by the predicted one.
    block : (n,) number of each point's wall block.
    random : source of random numbers.

    Returns
    -------
    float : the p-value (1 + b) / (1 + N), if b of N sign flips reach the observed statistic.
    """
    observed, largest = _scores_with_flipped_signs(squares, shapes, block, random)
    return float((1 + np.sum(largest >= observed)) / (1 + DRAWS))


def null_critical_score(squares: FloatArray, shapes: list[FloatArray], block: NDArray[np.int64], random: KeyedRandom) -> float:
    """Return the critical value of the test of `null_p_value`, to compute how large a noise effect must be to be found.

    It is the quantile of the null distribution at the significance level `mean.significance`. The arguments are those of
    `null_p_value`.
    """
    _, largest = _scores_with_flipped_signs(squares, shapes, block, random)
    return float(np.quantile(largest, 1 - thresholds().mean.significance))


def _scores_with_flipped_signs(
    squares: FloatArray, shapes: list[FloatArray], block: NDArray[np.int64], random: KeyedRandom
) -> tuple[float, FloatArray]:
    """The largest standardised score over the candidates, observed and (DRAWS,) with the signs flipped by wall block."""
    _, number = np.unique(block, return_inverse=True)
    scores = np.stack([np.bincount(number, (squares - 1) * shape) for shape in shapes])
    size = np.sqrt(np.sum(scores**2, axis=1))
    signs = random.child("spread").generator().choice([-1.0, 1.0], size=(scores.shape[1], DRAWS))
    return float(np.max(scores.sum(axis=1) / size)), np.max(scores @ signs / size[:, None], axis=0)
