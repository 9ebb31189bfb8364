"""Statistics that a few gross errors do not disturb."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NMAD_FACTOR = 1.4826
"""Median absolute deviation to standard deviation, for normal errors."""


def nmad(values: NDArray[np.floating], centre: float | np.floating | None = None) -> float:
    """1.4826 median(|v - centre|), the standard deviation of normal errors, in the values' unit (Hoehle and Hoehle 2009).

    values: any shape, NaN left out; centre: their median by default. NaN where there are no values.
    """
    missing = np.isnan(values)
    known = values[~missing] if missing.any() else values
    if known.size == 0:
        return float("nan")
    middle = np.median(known) if centre is None else centre
    return float(_NMAD_FACTOR * np.median(np.abs(known - middle)))
