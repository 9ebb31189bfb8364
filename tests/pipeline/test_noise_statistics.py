"""Outlier shares, normality tests and binned statistics, against distributions known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.noise.statistics import (
    NORMAL_BEYOND_3,
    histogram,
    normality,
    quantile_edges,
    statistics_by_bin,
    tail_figures,
    without_outliers,
)
from scene.common.keyed_random import KeyedRandom

NORMAL = KeyedRandom(5).generator().normal(0.002, 0.01, 200_000)


def test_tails_of_a_normal_distribution() -> None:
    """Standard errors of n = 200,000: skewness 0.0055, kurtosis 0.011, share 0.00012; limits four of them."""
    found = tail_figures(NORMAL)
    assert found.skewness == pytest.approx(0, abs=0.022)
    assert found.excess_kurtosis == pytest.approx(0, abs=0.044)
    assert found.beyond_3_nmad == pytest.approx(NORMAL_BEYOND_3, abs=0.0005)
    assert found.quantile_975_m - found.quantile_025_m == pytest.approx(2 * 1.95996 * 0.01, rel=0.01)


def test_tails_of_a_uniform_distribution() -> None:
    """Excess kurtosis -6/5 exactly; nothing lies beyond three NMAD, which are 1.11 half widths."""
    found = tail_figures(np.linspace(-1, 1, 100_001))
    assert found.excess_kurtosis == pytest.approx(-1.2, abs=1e-3)
    assert found.beyond_3_nmad == 0
    assert found.quantile_250_m == pytest.approx(-0.5)
    assert tail_figures(np.array([np.nan])).to_dict()["largest_m"] is None


def test_normality_holds_its_level_and_sees_a_heavy_tail() -> None:
    """200 normal samples at 5 %: rejections are binomial, mean 10, sigma 3.1; false failure rate of 3 to 21: 0.3 %."""
    random = KeyedRandom(6)
    p_values = [normality(NORMAL, 500, random.child(number)).p_value for number in range(200)]
    assert 3 <= sum(p is not None and p < 0.05 for p in p_values) <= 21
    heavy = random.child("heavy").generator().standard_t(3, 50_000)
    found = normality(heavy, 1000, random)
    assert found.p_value is not None
    assert found.p_value < 1e-6
    assert normality(NORMAL, 5, random).p_value is None


def test_bins_hold_what_lies_in_them() -> None:
    covariate = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 9.0, np.nan])
    values = np.array([1.0, 3.0, 10.0, np.nan, 20.0, 7.0, 8.0])
    first, second = statistics_by_bin(values, covariate, [0, 1, 2])
    assert (first.statistics.count, first.statistics.median) == (2, 2.0)
    assert (second.statistics.count, second.statistics.median) == (2, 15.0)
    with pytest.raises(ValueError, match="shape"):
        statistics_by_bin(values, covariate[:3], [0, 1])


def test_edges_share_the_values_out() -> None:
    edges = quantile_edges(np.arange(1000.0), 4)
    assert [item.statistics.count for item in statistics_by_bin(np.zeros(1000), np.arange(1000.0), edges)] == [250, 250, 250, 250]
    assert len(quantile_edges(np.zeros(10))) == 2


def test_histogram_follows_the_normal_curve() -> None:
    found = histogram(NORMAL, bins=24)
    expected = np.maximum(found.normal, 1)
    assert np.max(np.abs(found.counts - found.normal) / np.sqrt(expected)) < 6  # NMAD's own error of 0.3 % included


def test_gross_errors_are_left_out() -> None:
    values = np.append(NORMAL[:1000], [1.0, -1.0])
    assert np.isnan(without_outliers(values)[-2:]).all()
    assert np.isnan(without_outliers(values)).sum() <= 3
