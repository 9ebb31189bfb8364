"""Curves of one variable by values at even distances, linear between them: what an empirical term is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scene.backend import dr, mi
from scene.mesh import FloatArray
from scene.upload import on_device
from sensors.device import bounded, opaque


def curve(x: mi.Float64, low: float, high: float, values: Sequence[float], period: float) -> mi.Float64:
    """The curve at x: `values` from `low` to `high`, held beyond; of a period above 0, x counts modulo that."""
    if period:
        (cycle,) = opaque(period)
        x = x - cycle * dr.floor(x / cycle)
    start, step = opaque(low, (high - low) / (len(values) - 1))
    place = bounded((x - start) / step, 0.0, len(values) - 1.0)
    index = mi.UInt32(bounded(dr.floor(place), 0.0, len(values) - 2.0))
    share, table = place - mi.Float64(index), on_device(mi.Float64, np.asarray(values, dtype=np.float64))
    left, right = (dr.gather(mi.Float64, table, index + offset) for offset in (0, 1))
    return left + share * (right - left)


def curve_on_host(x: FloatArray, low: float, high: float, values: Sequence[float], period: float) -> FloatArray:
    """The same for a NumPy array (n,)."""
    return np.asarray(np.interp(np.mod(x, period) if period else x, np.linspace(low, high, len(values)), values))
