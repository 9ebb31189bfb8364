"""Effects of a stereo matcher on small disparity maps; the expected maps are computed cell by cell, with simple loops."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from scene.geometry.mesh import FloatArray
from sensors.effects.edge_fattening import EdgeFattening, FatteningTrials
from sensors.effects.smoothing import smoothed
from sensors.effects.texture_noise import WINDOW, texture
from sensors.signal_chain.matches import fill_gaps


def random_relief(seed: int) -> FloatArray:
    """Return disparities (20, 30) with smooth parts, steps and unmatched cells."""
    random = np.random.default_rng(seed)
    relief = np.cumsum(random.uniform(-0.5, 0.5, (20, 30)), axis=1) + 8.0 * (
        cv2.blur(random.uniform(0, 1, (20, 30)), (7, 7)) > 0.5
    )
    relief[random.uniform(0, 1, relief.shape) < 0.15] = np.nan
    relief[5, :12], relief[9, :] = np.nan, np.nan
    return relief


def bridged_slowly(disparity: FloatArray, reach: float) -> FloatArray:
    result = disparity.copy()
    for row in range(disparity.shape[0]):
        matched = np.flatnonzero(~np.isnan(disparity[row]))
        for before, after in itertools.pairwise(matched):
            if after - before - 1 <= reach:
                result[row, before + 1 : after] = min(disparity[row, before], disparity[row, after])
    return result


def fattened_slowly(disparity: FloatArray, radius: int, step_px: float) -> FloatArray:
    background, result = bridged_slowly(disparity, np.inf), disparity.copy()
    rows, columns = disparity.shape
    near = [(0, 1), (0, -1), (1, 0), (-1, 0)]
    for row, column in np.ndindex(rows, columns):
        for y, x in np.ndindex(rows, columns):
            if (y - row) ** 2 + (x - column) ** 2 > radius**2 or np.isnan(disparity[y, x]):
                continue
            beside = [background[y + i, x + j] for i, j in near if 0 <= y + i < rows and 0 <= x + j < columns]
            if any(disparity[y, x] - other > step_px for other in beside) and disparity[y, x] - background[row, column] > step_px:
                result[row, column] = np.fmax(result[row, column], disparity[y, x])
    return result


def texture_slowly(image: FloatArray, reduction: int) -> FloatArray:
    rows, columns = image.shape
    gradient = np.zeros_like(image)
    for row, column in np.ndindex(rows, columns - 2):
        rise = image[row, column + 2] - image[row, column]
        gradient[row, column + 1] = 0.0 if np.isnan(rise) else rise / (2 * reduction)
    padded = np.pad(gradient**2, WINDOW // 2)
    return np.array([[padded[y : y + WINDOW, x : x + WINDOW].sum() for x in range(columns)] for y in range(rows)])


def fattened(relief: FloatArray, radius: int, step_px: float) -> FloatArray:
    """Rims of disparities (rows, columns), px, grown by some cells."""
    return EdgeFattening(radius_px=radius, step_px=step_px).filtered(relief, 1.0, step_px)


@pytest.mark.parametrize("seed", [1, 2])
def test_fast_rasters_agree_with_their_slow_twins(seed: int) -> None:
    relief = random_relief(seed)
    for reach in (1, 2, np.inf):
        np.testing.assert_array_equal(fill_gaps(relief, reach), bridged_slowly(relief, reach))
    for radius in (0, 1, 3):
        np.testing.assert_array_equal(fattened(relief, radius, 2.0), fattened_slowly(relief, radius, 2.0))
    np.testing.assert_allclose(texture(relief, 4), texture_slowly(relief, 4), rtol=1e-12, atol=1e-15)


def test_trials_of_fattening_at_some_cells_are_those_of_the_whole_map() -> None:
    relief, rows = random_relief(3), (np.array([0, 4, 4, 7]), np.array([2, 0, 5, 1]))
    trials = FatteningTrials(relief, lambda raster: raster[rows])
    for window, radius, step_px in itertools.product(("rim", "disc", "square"), (1, 3, 1), (0.5, 2.0)):
        effect = EdgeFattening.model_validate({"radius_px": radius, "step_px": step_px, "window": window})
        whole = effect.filtered(relief, 1.0, 1.0)
        np.testing.assert_array_equal(trials.fattened(effect, 1.0, 1.0), whole[rows])


def test_niche_rims_shrink_by_the_radius_and_slopes_stay() -> None:
    """A square of 41 cells shrinks to 31 for a radius of 5; a slope below one matched pixel per cell is no step."""
    wall = np.full((80, 90), 30.0)
    wall[20:61, 25:66] = 10.0
    expected = np.full_like(wall, 30.0)
    expected[25:56, 30:61] = 10.0
    np.testing.assert_array_equal(fattened(wall, 5, 4.0), expected)
    slope = np.add.outer(0.9 * 4.0 * np.arange(50), -0.9 * 4.0 * np.arange(25))
    np.testing.assert_array_equal(fattened(slope, 5, 4.0), slope)


def test_outlines_grow_at_steps_that_are_high_enough() -> None:
    wall = np.full((40, 90), 30.0)
    wall[:, 30:60], wall[:, 60:] = 33.0, 40.0
    grown = EdgeFattening(radius_px=5, step_px=4.0).filtered(wall, 1.0, 1.0)
    expected = wall.copy()
    expected[:, 55:60] = 40.0
    np.testing.assert_array_equal(grown, expected)
    np.testing.assert_array_equal(EdgeFattening(radius_px=5).filtered(wall, 1.0, 4.0), expected)


def test_smoothing_leaves_unmatched_cells_empty_and_out_of_the_mean() -> None:
    relief = random_relief(3)
    flat = np.where(np.isnan(relief), np.nan, 7.0)
    np.testing.assert_allclose(smoothed(flat, 2.0), flat, rtol=1e-12)
    np.testing.assert_array_equal(np.isnan(smoothed(relief, 2.0)), np.isnan(relief))
