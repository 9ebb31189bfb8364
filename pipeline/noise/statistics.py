"""Describe the distribution of differences: tails, normality, and dependence on covariates.

Location and size (median, StD, RMSE, NMAD) are in `pipeline.change.difference.statistics`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pipeline.change.difference import DifferenceStatistics, statistics
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

NORMAL_BEYOND_3 = 0.0027
"""Share of a normal distribution more than three sigma from its median."""
_LEAST_SAMPLE = 20
"""Fewest values for which D'Agostino and Pearson's test is valid."""
_MOST_SAMPLE = 5000
"""Most values that are tested; with more, irrelevant departures become significant."""


@dataclass(frozen=True)
class TailFigures:
    """Quantiles, skewness and kurtosis of the differences of a map, which show how far their distribution is from a normal one.

    Attributes
    ----------
    quantile_025_m, quantile_250_m, quantile_750_m, quantile_975_m : float
        Quantiles at 2.5, 25, 75 and 97.5 %, m.
    skewness, excess_kurtosis : float
        Both are 0 for a normal distribution.
    beyond_3_nmad : float
        Share of the differences farther than three NMAD from the median (normal: 0.0027).
    largest_m : float
        Largest absolute difference, m.
    """

    quantile_025_m: float
    quantile_250_m: float
    quantile_750_m: float
    quantile_975_m: float
    skewness: float
    excess_kurtosis: float
    beyond_3_nmad: float
    largest_m: float

    def to_dict(self) -> dict[str, float | None]:
        """Return quantiles (m), skewness and kurtosis of differences as a dictionary for JSON; NaN becomes null."""
        return {name: None if np.isnan(value) else value for name, value in dataclasses.asdict(self).items()}


def tail_figures(values: NDArray[np.floating]) -> TailFigures:
    """Compute quantiles, skewness and kurtosis of differences, to see how far they are from normally distributed.

    values: differences, m, any shape; NaN is ignored. All results are NaN if no value is left.
    """
    known = values[~np.isnan(values)].astype(np.float64)
    if known.size == 0:
        return TailFigures(*[float("nan")] * 8)
    size = statistics(known)
    spread = size.standard_deviation
    skewness = float(np.mean(((known - size.mean) / spread) ** 3)) if spread else 0.0
    kurtosis = float(np.mean(((known - size.mean) / spread) ** 4)) - 3.0 if spread else 0.0
    low, lower, upper, high = np.quantile(known, [0.025, 0.25, 0.75, 0.975]).tolist()
    beyond = float(np.mean(np.abs(known - size.median) > 3 * size.nmad))
    return TailFigures(low, lower, upper, high, skewness, kurtosis, beyond, float(np.abs(known).max()))


@dataclass(frozen=True)
class Normality:
    """Result of D'Agostino and Pearson's (1973) test whether a sample is normally distributed.

    Attributes
    ----------
    statistic : float or None
        Test statistic K2, which combines skewness and kurtosis; None if there are too few values. It follows a chi-squared
        distribution with 2 degrees of freedom if the sample is normally distributed.
    p_value : float or None
        p-value of the test; None if there are too few values.
    sample : int
        Number of values that were drawn for the test.
    """

    statistic: float | None
    p_value: float | None
    sample: int

    def to_dict(self) -> dict[str, Any]:
        """Return statistic, p-value and sample size of a test for a normal distribution as a dictionary for JSON."""
        return dataclasses.asdict(self)


def normality(values: NDArray[np.floating], effective: float, random: KeyedRandom) -> Normality:
    """Test whether values, such as the differences of a map, may be normally distributed (D'Agostino and Pearson 1973).

    Parameters
    ----------
    values : array of any shape
        The values; NaN is ignored.
    effective : float
        Number of independent values (`variogram.effective_sample_size`). At most so many, and at most 5,000, are drawn at
        random, because neighbours are correlated and a test of all pixels would reject every real map.
    random : KeyedRandom
        Source of the random draw.

    Returns
    -------
    Normality
        Statistic and p-value; None for both if fewer than 20 values can be drawn, or all are equal.
    """
    known = values[~np.isnan(values)]
    size = int(min(effective, known.size, _MOST_SAMPLE))
    if size < _LEAST_SAMPLE or np.ptp(known) == 0:
        return Normality(None, None, size)
    sample = random.generator().choice(known, size, replace=False).astype(np.float64)
    found = stats.normaltest(sample)
    return Normality(float(found.statistic), float(found.pvalue), size)


@dataclass(frozen=True)
class BinStatistics:
    """Statistics of the differences in one bin of a covariate, to see how noise depends on, for example, range.

    Attributes
    ----------
    low, high : float
        The bin [low, high), in the unit of the covariate.
    statistics : DifferenceStatistics
        Statistics of the differences in it, m.
    """

    low: float
    high: float
    statistics: DifferenceStatistics

    def to_dict(self) -> dict[str, Any]:
        """Return a bin's ends and the statistics of its differences as a dictionary for JSON; an infinite end becomes null."""
        low, high = (end if np.isfinite(end) else None for end in (self.low, self.high))
        return {"low": low, "high": high, **self.statistics.to_dict()}


def statistics_by_bin(
    values: NDArray[np.floating], covariate: NDArray[np.floating], edges: Sequence[float] | FloatArray
) -> list[BinStatistics]:
    """Compute statistics of differences in each bin of a covariate, to see how noise depends on, for example, range.

    Parameters
    ----------
    values, covariate : arrays of equal shape
        Differences, m, and the covariate of each. Pixels where either is NaN are ignored.
    edges : sequence of float
        Edges of the bins, ascending, in the unit of the covariate. The last bin includes its upper edge.
    """
    if values.shape != covariate.shape:
        raise ValueError(f"expected a covariate of shape {values.shape}, got {covariate.shape}")
    known = ~np.isnan(values) & ~np.isnan(covariate)
    found, place = values[known], covariate[known]
    number = np.searchsorted(edges, place, side="right") - 1
    number[place == edges[-1]] = len(edges) - 2
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(len(edges)))
    parts = (found[order[start:end]] for start, end in pairwise(starts))
    return [
        BinStatistics(float(low), float(high), statistics(part)) for (low, high), part in zip(pairwise(edges), parts, strict=True)
    ]


def quantile_edges(covariate: NDArray[np.floating], bins: int = 8) -> FloatArray:
    """Return edges of bins that hold equally many values of a covariate, such as range, for statistics in each bin.

    Parameters
    ----------
    covariate : array of any shape
        The values; NaN is ignored.
    bins : int
        Number of bins; fewer are made if many values are equal.

    Returns
    -------
    (bins + 1,) array
        Edges, ascending, in the unit of the covariate.
    """
    known = covariate[~np.isnan(covariate)]
    if known.size == 0:
        return np.array([0.0, 1.0])
    edges = np.unique(np.quantile(known, np.linspace(0, 1, bins + 1)))
    return edges if len(edges) > 1 else np.array([edges[0], np.nextafter(edges[0], np.inf)])


@dataclass(frozen=True)
class DensityHistogram:
    """Histogram of the differences of a map, with what a normal distribution of the same median and NMAD would give.

    Attributes
    ----------
    edges : (k + 1,) array
        Edges of k bins of equal width, m.
    counts : (k,) array
        Number of differences in each bin.
    normal : (k,) array
        Number that the normal distribution gives in each bin.
    """

    edges: FloatArray
    counts: NDArray[np.int64]
    normal: FloatArray


def histogram(values: NDArray[np.floating], bins: int = 100, half_width_nmads: float = 6.0) -> DensityHistogram:
    """Compute the histogram of differences around their median, beside that of a normal distribution.

    Parameters
    ----------
    values : array of any shape
        Differences, m; NaN is ignored.
    bins : int
        Number of bins.
    half_width_nmads : float
        Distance of the outermost edges from the median, in NMADs.
    """
    known = values[~np.isnan(values)]
    size = statistics(known)
    centre, sigma = (size.median, size.nmad or 1e-6) if size.count else (0.0, 1e-3)
    edges = centre + sigma * np.linspace(-half_width_nmads, half_width_nmads, bins + 1)
    counts, _ = np.histogram(known, edges)
    return DensityHistogram(edges, counts, size.count * np.diff(stats.norm.cdf(edges, centre, sigma)))


def without_outliers(values: NDArray[np.floating], nmads: float = 5.0) -> NDArray[np.floating]:
    """Remove outliers from differences before statistics that they would dominate, such as a variogram.

    values: differences, any shape, m. Returns them with NaN in place of those farther than `nmads` NMADs from their median.
    """
    size = statistics(values)
    return np.where(np.abs(values - size.median) <= nmads * size.nmad, values, np.nan)
