"""The noise of measured epochs as the thesis tabulates it (tables 4-6 and 4-7), and what its tables leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pipeline.change.difference import DifferenceStatistics, statistics
from pipeline.noise.statistics import Normality, TailFigures, normality, tails, without_outliers
from pipeline.noise.variogram import Variogram, VariogramModel, effective_sample_size, fit_variogram, variogram
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class EpochNoise:
    """One difference map over stable ground: size, tails, normality (of as many values as are independent), variogram.

    independent: effective sample size of the windows together.
    """

    name: str
    size: DifferenceStatistics
    tails: TailFigures
    normality: Normality
    variogram: Variogram
    model: VariogramModel
    independent: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return {
            "name": self.name,
            **self.size.to_dict(),
            **self.tails.to_dict(),
            "normality": self.normality.to_dict(),
            "variogram": {**self.variogram.to_dict(), "model": self.model.to_dict()},
            "independent_values": self.independent,
        }


@dataclass(frozen=True)
class Trend:
    """A straight line through the epochs' values: change per epoch, m, and the p-value of no change; None for fewer than 4."""

    per_epoch_m: float | None
    p_value: float | None

    def to_dict(self) -> dict[str, float | None]:
        """As JSON holds it."""
        return {"per_epoch_m": self.per_epoch_m, "p_value": self.p_value}


def epoch_noise(name: str, stable: NDArray[np.floating], windows: FloatArray, gsd_m: float, random: KeyedRandom) -> EpochNoise:
    """stable: the map (h, w), m, NaN where it is not stable; windows: (k, n, n) of it, for the variogram."""
    rest = without_outliers(windows)
    found = variogram(rest, gsd_m, largest_lag_m=0.75 * gsd_m * windows.shape[1])
    model = fit_variogram(found)
    independent = sum(
        effective_sample_size(model, ~np.isnan(part), gsd_m) for part in windows if np.count_nonzero(~np.isnan(part))
    )
    return EpochNoise(name, statistics(stable), tails(stable), normality(windows, independent, random), found, model, independent)


def trend(values: Sequence[float]) -> Trend:
    """The trend of one figure, m, over the epochs in their order."""
    if len(values) < 4:
        return Trend(None, None)
    line = stats.linregress(np.arange(len(values)), values)
    return Trend(float(line.slope), float(line.pvalue))


def systematic(maps: NDArray[np.floating]) -> NDArray[np.float32]:
    """(h, w) mean over the epochs of (e, h, w) maps, m: what all share, as the reference's errors; NaN where one has none."""
    return np.asarray(np.mean(maps, axis=0, dtype=np.float64), dtype=np.float32)
