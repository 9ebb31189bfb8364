"""Tiles compared with the raster they were cut from."""

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.change.tiles import TileConfig, tiles
from scene.common.errors import InputError
from scene.geometry.grid import Grid


def raster(height, width):
    values = np.arange(height * width, dtype=np.float32).reshape(height, width)
    return values, values.astype(np.int32) + 1, Grid(10.0, 20.0, 0.25, width, height)


@pytest.mark.parametrize("shape", [(20, 30), (23, 31), (7, 4), (1, 1)])
@pytest.mark.parametrize("overlap", [0, 3])
def test_tiles_cover_and_reassemble(shape, overlap):
    values, block, grid = raster(*shape)
    again, labels, times = np.full(shape, np.nan, np.float32), np.zeros(shape, np.int32), np.zeros(shape, int)
    for tile in tiles(values, block, grid, TileConfig(size_px=10, overlap_px=overlap, minimum_valid_share=0)):
        assert tile.values.shape == tile.block.shape == tile.grid.shape == (10, 10)
        window = np.s_[tile.row : tile.row + 10, tile.column : tile.column + 10]
        height, width = again[window].shape
        again[window], labels[window] = tile.values[:height, :width], tile.block[:height, :width]
        times[window] += 1
        beyond = np.ones((10, 10), dtype=bool)
        beyond[:height, :width] = False
        assert np.isnan(tile.values[beyond]).all()
        assert (tile.block[beyond] == 0).all()
        assert tile.valid_share == height * width / 100
    np.testing.assert_array_equal(again, values)
    np.testing.assert_array_equal(labels, block)
    assert times.min() == 1
    assert overlap or times.max() == 1


def test_place_on_the_wall():
    values, block, grid = raster(25, 35)
    cut = {tile.name: tile for tile in tiles(values, block, grid, TileConfig(size_px=10, minimum_valid_share=0))}
    assert len(cut) == 12
    tile = cut["r00020_c00010"]
    assert tile.grid == Grid(10.0 + 10 * 0.25, 20.0 - 20 * 0.25, 0.25, 10, 10)
    assert tile.values[2, 3] == values[22, 13]


def test_tiles_with_too_few_data_are_left_out():
    values, block, grid = raster(20, 20)
    values[:10, :10] = np.nan
    values[0, 0] = 1.0
    values[10:16, 10:20] = np.nan
    names = [tile.name for tile in tiles(values, block, grid, TileConfig(size_px=10, minimum_valid_share=0.4))]
    assert names == ["r00000_c00010", "r00010_c00000", "r00010_c00010"]
    names = [tile.name for tile in tiles(values, block, grid, TileConfig(size_px=10, minimum_valid_share=0.41))]
    assert names == ["r00000_c00010", "r00010_c00000"]


def test_errors():
    values, block, grid = raster(5, 5)
    with pytest.raises(ValidationError, match="overlap_px must be less than size_px"):
        TileConfig(size_px=10, overlap_px=10)
    with pytest.raises(InputError, match="differ in shape"):
        list(tiles(values, block[1:], grid, TileConfig()))
