"""Both faces of a laser scanner: the mean that instrument errors of opposite sign cancel in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.signal_chain.observation import Observation


def mean_of_faces(first: Observation, second: Observation, tolerance_m: float) -> Observation:
    """One observation of two scans of the same directions, (h, w) each, from the same place.

    A cell holds the mean of both where their ranges differ by at most `tolerance_m`, else what the first face saw (a mean over an
    edge would be a point in the air), or the only return there is. Labels and times are the first face's.
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
