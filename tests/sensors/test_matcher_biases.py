"""Systematic errors of a stereo matcher against closed forms: shifted tiles, and windows on slanted surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from surfaces import plane
from test_stereo_effects import NORMAL, disparity, observe, rig

from sensors.effects.edge_fattening import EdgeFattening
from sensors.stereo.stereo_pair import REDUCTION


def test_tiles_are_shifted_as_a_checkerboard_from_the_frames_corner() -> None:
    mesh, effect = plane(NORMAL, np.zeros(3)), {"name": "tile_shift", "amplitude_px": 0.4, "tile_px": 230.0}
    true, found = (disparity(observe(mesh, effects, "medium"), rig()) for effects in ([], [effect]))
    row, column = ((np.arange(count) + 0.5) * REDUCTION["medium"] // 230 for count in true.shape)
    expected = np.where(np.isnan(true), np.nan, 0.4 * (-1.0) ** (row[:, None] + column))
    np.testing.assert_allclose(found - true, expected, rtol=0, atol=1e-6)


def test_a_slant_biases_disparities_by_its_gradient_up_to_the_limit() -> None:
    """Central differences of the true disparities of a plane; cells with one neighbour are left out."""
    mesh = plane(np.array([0.3, 0.2, 1.0]), np.zeros(3))
    for values, limit in (({"slope_px": 3.0}, 1.0), ({"row_px": -5.0}, 1.0), ({"slope_px": 30.0}, 0.2)):
        effect = {"name": "fronto_parallel_bias", "limit_px": limit, **values}
        true, found = (disparity(observe(mesh, effects, "medium"), rig()) for effects in ([], [effect]))
        down, along = (each / REDUCTION["medium"] for each in np.gradient(true))
        expected = values.get("slope_px", 0.0) * np.hypot(down, along) + values.get("row_px", 0.0) * along
        inner = ~np.isnan(expected)
        np.testing.assert_allclose((found - true)[inner], np.clip(expected[inner], -limit, limit), rtol=0, atol=1e-6)
        assert inner.mean() > 0.3
        assert np.nanmax(np.abs(found - true)) > 0.1


@pytest.mark.parametrize("window", ["disc", "square"])
def test_a_window_takes_the_nearest_rock_on_slopes_too(window: str) -> None:
    """Compared with a loop over the cells; unmatched cells stay unmatched and count as nothing."""
    random = np.random.default_rng(4)
    relief = np.add.outer(0.4 * np.arange(20), -0.7 * np.arange(24)) + random.random((20, 24))
    relief[random.random(relief.shape) < 0.1] = np.nan
    expected, radius = relief.copy(), 3
    for row, column in np.argwhere(~np.isnan(relief)):
        near = [
            relief[i, j]
            for i, j in np.ndindex(relief.shape)
            if max(abs(i - row), abs(j - column)) <= radius
            and (window == "square" or (i - row) ** 2 + (j - column) ** 2 <= radius**2)
        ]
        largest = np.nanmax(near)
        expected[row, column] = largest if largest - relief[row, column] > 1.5 else relief[row, column]
    effect = EdgeFattening.model_validate({"radius_px": 12.0, "step_px": 1.5, "window": window})
    np.testing.assert_array_equal(effect.filtered(relief, 4.0, 4.0), expected)
