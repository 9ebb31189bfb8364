"""Shifted tiles of a matcher are found from their seams, beside smooth errors and noise; nothing is found without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.gap.noise_and_edges.tile_seams import detectable_tile_shift, find_tile_seams, find_unequal_tiles
from pipeline.gap.residuals.nominal_pair import PixelGeometry
from pipeline.gap.residuals.stereo_residuals import StereoResiduals

STEP, COLUMNS, ROWS, SIGMA = 16.0, 150, 100, 0.3


def residuals(seed: int, amplitude: float, tile: float) -> StereoResiduals:
    """Return residuals of a checkerboard, white noise and a smooth error of 0.5 px, of which a tenth of the cells is missing."""
    random = np.random.default_rng(seed)
    u, v = (each.ravel() for each in np.meshgrid(100.0 + STEP * np.arange(COLUMNS), 60.0 + STEP * np.arange(ROWS)))
    kept = random.random(len(u)) > 0.1
    u, v = u[kept], v[kept]
    checkerboard = (-1.0) ** (u // tile + v // tile)
    smooth = 0.5 * np.sin(2 * np.pi * u / 900.0 + v / 300.0)
    value = amplitude * checkerboard + smooth + SIGMA * random.standard_normal(len(u))
    count, every = len(u), np.ones(len(u), dtype=bool)
    geometry = PixelGeometry(u, v, *[np.zeros(count)] * 10)
    at, sigma = np.stack([u, v], axis=1) / 50, np.full(count, SIGMA)
    covariates = {"image_x": u, "image_y": v}
    return StereoResiduals(value, sigma, sigma, every, every, np.ones((count, 1)), at, covariates, np.arange(count), geometry)


@pytest.mark.parametrize(("amplitude", "tile"), [(0.2, 230.0), (-0.4, 131.0), (0.1, 512.0)])
def test_tiles_are_found_with_their_side_and_shift(amplitude: float, tile: float) -> None:
    part = residuals(1, amplitude, tile)
    found = find_tile_seams(part, part.value)
    assert found is not None
    assert found.tile_px == pytest.approx(tile, abs=4 * found.tile_std_px)
    assert found.tile_std_px < 0.01 * tile
    assert found.amplitude_px == pytest.approx(amplitude, abs=5 * found.amplitude_std_px)


def test_nothing_is_found_without_tiles() -> None:
    """The significance level is 0.0001 a measurement, so one of 20 is a chance of 0.2 %."""
    for seed in range(20):
        part = residuals(seed, 0.0, 230.0)
        assert find_tile_seams(part, part.value) is None


def _with_unequal_tiles(seed: int, sigma: float, tile: float) -> StereoResiduals:
    """Return residuals in which each tile is shifted by a random amount of this standard deviation."""
    part = residuals(seed, 0.0, tile)
    shifts = sigma * np.random.default_rng(seed + 1000).standard_normal((40, 40))
    column, row = (np.floor(x / tile).astype(int) for x in (part.geometry.u, part.geometry.v))
    return replace(part, value=part.value + shifts[row, column])


@pytest.mark.parametrize(("sigma", "tile"), [(0.3, 230.0), (0.6, 131.0), (0.3, 512.0)])
def test_tiles_with_unequal_shifts_are_found_with_their_side_and_jumps(sigma: float, tile: float) -> None:
    """Jumps between two independent shifts have sqrt(2) times their standard deviation.

    Tiles of 512 px make 23 jumps, which know it to 15 %; three times that is allowed.
    """
    part = _with_unequal_tiles(5, sigma, tile)
    assert find_tile_seams(part, part.value) is None
    found = find_unequal_tiles(part, part.value)
    assert found is not None
    assert found.tile_px == pytest.approx(tile, rel=0.02)
    assert found.jump_px == pytest.approx(np.sqrt(2) * sigma, rel=0.45)
    assert f"every {found.tile_px:.3g} px" in found.note


def test_no_unequal_tiles_are_found_without_seams_or_at_one_edge() -> None:
    """The significance level is 0.0001, so one of 20 is a chance of 0.2 %. A fault of 3 px runs along one column and one row."""
    for seed in range(20):
        part = residuals(seed, 0.0, 230.0)
        fault = 3.0 * (part.geometry.u > 1200.0) + 3.0 * (part.geometry.v > 700.0)
        assert find_unequal_tiles(part, part.value) is None
        assert find_unequal_tiles(part, part.value + fault) is None


def test_jumps_along_one_axis_alone_are_no_tiles() -> None:
    """Pixel locking on a tilted plane makes jumps between columns only; a strip within one row of tiles has no other seams."""
    for seed in range(10):
        part = residuals(seed, 0.0, 160.0)
        assert find_unequal_tiles(part, part.value + 0.2 * (part.geometry.u / 160.0 % 1.0)) is None
    tiles = _with_unequal_tiles(5, 0.6, 230.0)
    strip = tiles.part(np.flatnonzero((tiles.geometry.v > 700.0) & (tiles.geometry.v < 915.0)))
    assert find_unequal_tiles(strip, strip.value) is None


def test_tiles_of_the_detectable_shift_are_found_in_95_of_100_measurements() -> None:
    """On average 57 of 60 measurements show the tiles. By chance fewer than 51 do in 0.1 % of trials, and all in 5 %."""
    quiet = residuals(0, 0.0, 230.0)
    limit = detectable_tile_shift(quiet, quiet.value)
    tile = float(limit.at["tile_px"])
    assert 0.01 < limit.size < 0.1
    found = [find_tile_seams(part, part.value) for part in (residuals(seed, limit.size, tile) for seed in range(1, 61))]
    assert 51 <= sum(each is not None for each in found) < 60


def test_pixels_on_no_raster_have_no_seams() -> None:
    part = residuals(1, 0.4, 230.0)
    random = np.random.default_rng(2)
    count = len(part)
    geometry = PixelGeometry(*(random.uniform(0, 2000, (2, count))), *[np.zeros(count)] * 10)
    assert find_tile_seams(replace(part, geometry=geometry), part.value) is None
    assert find_unequal_tiles(replace(part, geometry=geometry), part.value) is None
    assert "no raster" in detectable_tile_shift(replace(part, geometry=geometry), part.value).note
