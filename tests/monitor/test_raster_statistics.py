"""Quantiles and means over squares against NumPy's and SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from pipeline.monitoring.raster_statistics import dilated, mean_over_squares, quantiles

RANDOM = np.random.default_rng(1)


@pytest.mark.parametrize("count", [1, 2, 7, 1000])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_quantiles_are_those_of_numpy(count: int, kind: type) -> None:
    values, shares = RANDOM.normal(size=count).astype(kind), [0.0, 0.1, 0.5, 0.95, 1.0]
    np.testing.assert_allclose(quantiles(values, shares), np.quantile(values, shares), rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(quantiles(np.sort(values), shares, ordered=True), quantiles(values, shares))


@pytest.mark.parametrize("side", [3, 5, 9])
def test_means_over_squares_are_those_of_scipy(side: int) -> None:
    values = RANDOM.normal(size=(41, 57)).astype(np.float32)
    np.testing.assert_allclose(mean_over_squares(values, side), ndimage.uniform_filter(values, side), atol=1e-6)


def test_a_mask_grows_by_its_margin() -> None:
    mask = RANDOM.uniform(size=(41, 57)) < 0.02
    np.testing.assert_array_equal(dilated(mask, 2), ndimage.binary_dilation(mask, np.ones((5, 5))))
    assert not dilated(np.zeros((9, 9), dtype=bool), 2).any()
