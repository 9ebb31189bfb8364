"""Magnitude-frequency law of rockfalls: how many are larger than a volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

_FEWEST = 8


@dataclass(frozen=True)
class PowerLaw:
    """Magnitude-frequency law of rockfalls, N(> V) = n (V / V0)^-b: how many are larger than a volume V.

    Attributes
    ----------
    exponent, low, high : float
        The exponent b, and the ends of its 95 % interval.
    smallest_m3 : float
        Volume V0, m3, above which the law holds.
    count : int
        Number n of rockfalls of at least this volume.
    """

    exponent: float
    low: float
    high: float
    smallest_m3: float
    count: int


def fit_power_law(volumes_m3: Sequence[float]) -> PowerLaw | None:
    """Fit the magnitude-frequency law N(> V) = n (V / V0)^-b, the number of rockfalls larger than V, to their volumes, m3.

    The exponent is the maximum-likelihood estimate b = n / sum(log(V / V0)) over the n rockfalls of at least V0. Its interval
    follows from n (true b) / (estimated b), which has a gamma distribution of shape n and scale 1. V0 is the volume
    for which data and law have the least Kolmogorov-Smirnov distance (Clauset, Shalizi and Newman 2009, section 3.3).

    Returns None for fewer than eight rockfalls.
    """
    ordered = np.sort(np.asarray(volumes_m3, dtype=np.float64))
    ordered = ordered[ordered > 0]
    best: tuple[float, float, int] | None = None
    for start in range(len(ordered) - _FEWEST + 1):
        part = ordered[start:]
        total = float(np.log(part / part[0]).sum())
        if total <= 0:
            continue
        exponent = len(part) / total
        theory = 1 - (part / part[0]) ** -exponent
        distance = float(np.abs(theory - (np.arange(len(part)) + 0.5) / len(part)).max())
        if best is None or distance < best[0]:
            best = (distance, exponent, start)
    if best is None:
        return None
    _, exponent, start = best
    count = len(ordered) - start
    low, high = (float(gammaincinv(count, share)) / count * exponent for share in (0.025, 0.975))
    return PowerLaw(exponent, low, high, float(ordered[start]), count)
