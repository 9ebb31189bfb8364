"""Describe the noise of each measured epoch: its size, tails, normality, variogram, and trend over the epochs.

The statistics are those of tables 4-6 and 4-7 of the thesis, plus the variogram and the number of independent values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pipeline.change.difference import DifferenceStatistics, statistics
from pipeline.noise.statistics import Normality, TailFigures, normality, tail_figures, without_outliers
from pipeline.noise.variogram import Variogram, VariogramModel, effective_sample_size, fit_variogram, variogram
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray


@dataclass(frozen=True)
class EpochNoise:
    """Noise statistics of one measured difference map over stable ground, where nothing fell.

    Attributes
    ----------
    name : Name of the map.
    size : Median, standard deviation, RMSE and NMAD, m.
    tails : Quantiles, skewness and excess kurtosis.
    normality : Test for a normal distribution, on a random subsample of as many values as are independent.
    variogram, model : Empirical variogram and the variogram model fitted to it.
    independent : Number of independent values (effective sample size) in all compared windows (square parts) of the map.
    """

    name: str
    size: DifferenceStatistics
    tails: TailFigures
    normality: Normality
    variogram: Variogram
    model: VariogramModel
    independent: float

    def to_dict(self) -> dict[str, Any]:
        """Return the noise statistics of one difference map as a dictionary for `calibration.json`; lengths in m."""
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
    """Linear trend over the epochs of one statistic of the measured difference maps, such as their median.

    Attributes
    ----------
    per_epoch_m : Slope of the regression line, m per epoch; None for fewer than 4 epochs.
    p_value : p-value of the test for zero slope; None for fewer than 4 epochs.
    """

    per_epoch_m: float | None
    p_value: float | None

    def to_dict(self) -> dict[str, float | None]:
        """Return slope (m per epoch) and p-value of a trend over the epochs as a dictionary for `calibration.json`."""
        return {"per_epoch_m": self.per_epoch_m, "p_value": self.p_value}


def epoch_noise(name: str, stable: NDArray[np.floating], windows: FloatArray, gsd_m: float, random: KeyedRandom) -> EpochNoise:
    """Compute the noise statistics of one measured difference map: size, tails, normality and variogram.

    Parameters
    ----------
    name : Name of the map.
    stable : (h, w) differences, m; NaN outside stable ground.
    windows : (k, n, n) square parts of the same map, m, NaN outside stable ground; variogram and normality are computed there.
    gsd_m : Pixel size, m.
    random : Source of the random subsample for the normality test.
    """
    rest = without_outliers(windows)
    found = variogram(rest, gsd_m, largest_lag_m=0.75 * gsd_m * windows.shape[1])
    model = fit_variogram(found)
    independent = sum(
        effective_sample_size(model, ~np.isnan(part), gsd_m) for part in windows if np.count_nonzero(~np.isnan(part))
    )
    return EpochNoise(
        name, statistics(stable), tail_figures(stable), normality(windows, independent, random), found, model, independent
    )


def trend(values: Sequence[float]) -> Trend:
    """Fit a line to one value per epoch, and test whether its slope differs from 0, to see whether noise changes over time.

    values: one value per epoch, m, in the order of the epochs. With fewer than 4, slope and p-value are None.
    """
    if len(values) < 4:
        return Trend(None, None)
    line = stats.linregress(np.arange(len(values)), values)
    return Trend(float(line.slope), float(line.pvalue))


def systematic(maps: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the mean of several difference maps, which shows errors that all epochs share, such as the reference's.

    Parameters
    ----------
    maps : (e, h, w) difference maps of e epochs, m.

    Returns
    -------
    (h, w) mean, m; NaN where any map is NaN.
    """
    return np.asarray(np.mean(maps, axis=0, dtype=np.float64), dtype=np.float32)
