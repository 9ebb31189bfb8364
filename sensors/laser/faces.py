"""Average the two faces of a laser scanner, in which instrument errors of opposite sign cancel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.signal_chain.observation import Observation


def mean_of_faces(first: Observation, second: Observation, tolerance_m: float) -> Observation:
    """Average the scans of the first and the second face of a scanner, in which errors of its axes cancel.

    Both scans (h, w) have the same directions from the same place. A cell holds the mean if the two ranges differ by at most
    `tolerance_m`. Otherwise it holds the first face's point, because a mean across a depth edge would lie in the air; if only
    one face has a return, it holds that one. Labels and times are those of the first face.

    Parameters
    ----------
    first, second : Observation
        The scans in the first and in the second face.
    tolerance_m : float
        Largest difference of the ranges that is averaged, m.
    """
    both = np.abs(first.depth - second.depth) <= tolerance_m
    filled = ~first.valid

    def merged(mine: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
        shape = both.shape + (1,) * (mine.ndim - both.ndim)
        mean = np.where(both.reshape(shape), (mine + other) / 2, mine)
        return np.where(filled.reshape(shape), other, mean)

    return replace(
        first,
        points=merged(first.points, second.points),
        depth=merged(first.depth, second.depth),
        block=np.where(filled, second.block, first.block),
        intensity=None if first.intensity is None or second.intensity is None else merged(first.intensity, second.intensity),
        truth={name: merged(channel, second.truth[name]) for name, channel in first.truth.items()},
        offset=None if first.offset is None or second.offset is None else merged(first.offset, second.offset),
    )
