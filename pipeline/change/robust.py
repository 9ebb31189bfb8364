"""Provide statistics that are insensitive to outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NMAD_FACTOR = 1.4826
"""Ratio of standard deviation to median absolute deviation for normal errors."""


def nmad(values: NDArray[np.floating], centre: float | np.floating | None = None) -> float:
    """Estimate a standard deviation that outliers hardly change: the NMAD, 1.4826 median(|v - centre|).

    For normal errors it equals the standard deviation (Hoehle and Hoehle 2009). values: any shape; NaN is ignored. centre:
    their median by default. Returns NaN if there are no values.
    """
    missing = np.isnan(values)
    known = values[~missing] if missing.any() else values
    if known.size == 0:
        return float("nan")
    middle = np.median(known) if centre is None else centre
    return float(_NMAD_FACTOR * np.median(np.abs(known - middle)))
