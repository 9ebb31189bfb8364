"""Heights on a raster against planes that are known, and against a fit point by point."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.monitoring.gridding import gridded
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

GRID = Grid(10.0, 25.0, 0.1, 60, 50)


def drawn(count: int, seed: int = 1) -> FloatArray:
    """Points (n, 2) over the grid."""
    return np.random.default_rng(seed).uniform([10.0, 20.0], [16.0, 25.0], (count, 2))


def test_a_plane_comes_back_exactly() -> None:
    xy = drawn(40_000)
    points = np.column_stack([xy, 3.0 + 0.4 * xy[:, 0] - 1.3 * xy[:, 1]])
    found = gridded(points, GRID)
    x, y = 10.0 + (np.arange(60) + 0.5) * 0.1, 25.0 - (np.arange(50)[:, None] + 0.5) * 0.1
    assert found.known.all()
    np.testing.assert_allclose(found.height, 3.0 + 0.4 * x - 1.3 * y, atol=1e-5)
    np.testing.assert_allclose(found.slope_x, 0.4, atol=1e-4)
    np.testing.assert_allclose(found.slope_y, -1.3, atol=1e-4)
    assert np.nanmax(found.scatter) < 1e-4
    assert int(found.count.sum()) == 40_000


def test_the_same_as_a_fit_of_each_pixel() -> None:
    """The slow twin: least squares through the points in 3 x 3 pixels."""
    xy = drawn(6_000)
    z = np.sin(xy[:, 0]) + 0.01 * np.random.default_rng(2).normal(size=len(xy))
    found = gridded(np.column_stack([xy, z]), GRID)
    for row, column in ((0, 0), (7, 31), (49, 59), (20, 20)):
        centre = np.array([10.0 + (column + 0.5) * 0.1, 25.0 - (row + 0.5) * 0.1])
        near = (np.abs(xy - centre) < 0.15).all(axis=1)
        design = np.column_stack([np.ones(near.sum()), xy[near] - centre])
        if near.sum() < 4 or not np.isfinite(found.height[row, column]):
            continue
        fitted = np.linalg.lstsq(design, z[near], rcond=None)[0]
        np.testing.assert_allclose(
            [found.height[row, column], found.slope_x[row, column], found.slope_y[row, column]], fitted, rtol=1e-4, atol=1e-4
        )
        leverage = np.linalg.inv(design.T @ design)[0, 0]
        assert found.sigma[row, column] / found.scatter[row, column] == pytest.approx(np.sqrt(leverage), rel=1e-4)


def test_the_standard_deviation_is_that_of_the_heights() -> None:
    """Noise of 4 mm, 400 draws of 30 points a window: scatter within 2 %; standardised errors have unit variance within 5 %."""
    random = np.random.default_rng(3)
    xy = drawn(10_000, 4)
    truth = 0.7 * xy[:, 0]
    errors = []
    for _ in range(12):
        found = gridded(np.column_stack([xy, truth + 0.004 * random.normal(size=len(xy))]), GRID)
        x = 10.0 + (np.arange(60) + 0.5) * 0.1
        errors.append((found.height - 0.7 * x) / found.sigma)
    assert np.nanmedian(found.scatter) == pytest.approx(0.004, rel=0.02)
    assert np.nanstd(errors) == pytest.approx(1.0, abs=0.05)


def test_a_pixel_without_points_around_it_has_no_data() -> None:
    xy = drawn(20_000)
    xy = xy[(xy[:, 0] < 12.0) | (xy[:, 0] > 14.0)]
    found = gridded(np.column_stack([xy, xy[:, 0]]), GRID)
    assert not found.known[:, 22:38].any()
    assert found.known[:, :19].all()


def test_points_beside_the_grid_are_left_out() -> None:
    far = np.array([[0.0, 0.0, 1.0], [100.0, 22.0, 1.0]])
    assert int(gridded(far, GRID).count.sum()) == 0
