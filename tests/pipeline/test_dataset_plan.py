"""A data set without a tile is explained with numbers: the wall's size in pixels, the validation region, or pixels
without data.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.change.tiles import TileConfig
from pipeline.config.bundled import bundled_config
from pipeline.dataset.config import load_dataset_config
from pipeline.dataset.epoch import no_tile_error
from pipeline.dataset.plan import Split, check_tiles_filled, planned_epochs, tile_region
from scene.common.errors import InputError
from scene.geometry.grid import Grid


def check(width: int, height: int, split: Split, share: float, **tiles: Any) -> None:
    config = TileConfig(**{"size_px": 512, **tiles})
    grid = Grid(0.0, 0.0, 0.05, width, height)
    check_tiles_filled(split, tile_region(split, share, grid, config), grid, config)


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_a_wall_of_few_pixels_is_named(split: Split) -> None:
    """300 x 200 of 512 x 512 pixels are 22.9 %."""
    words = r"maps are 300 x 200 px \(gsd 0\.05 m\), which fill a tile of 512 px to 23 % at most, .* is 0\.5; use smaller tiles"
    with pytest.raises(InputError, match=words):
        check(300, 200, split, 0.0)
    check(300, 200, split, 0.0, minimum_valid_share=0.22)
    check(300, 200, split, 0.0, size_px=128)


def test_a_validation_region_that_is_too_narrow_is_named() -> None:
    """There are two columns of tiles; the second, for validation, has 600 - 512 = 88 columns of pixels, 17.2 % of a tile."""
    words = r"^validation_region: .* 600 x 700 px .*, and the validation region is 88 px wide: it fills a tile of 512 px to 17 %"
    with pytest.raises(InputError, match=words):
        check(600, 700, "val", 0.5)
    check(600, 700, "train", 0.5)
    check(600, 700, "test", 0.5)
    check(1024, 700, "val", 0.5)


def test_a_region_that_overlap_leaves_without_a_tile_is_named() -> None:
    """Columns begin at 0 and 400; training ends at 400, before the end of a tile of 512 pixels."""
    with pytest.raises(InputError, match=r"what the validation region leaves to train is 400 px wide: .* to 0 % at most"):
        check(900, 700, "train", 0.5, overlap_px=112, minimum_valid_share=0.0)


def test_pixels_without_data_are_named_where_they_are_the_cause() -> None:
    config = load_dataset_config(bundled_config("datasets", "small"))
    config = config.model_copy(update={"tiles": TileConfig(size_px=50, minimum_valid_share=0.5), "validation_region": 0.0})
    values = np.full((100, 100), np.nan, np.float32)
    values[:20, :50] = 0.0
    error = no_tile_error(config, planned_epochs(config)[0], values, Grid(0.0, 0.0, 0.05, 100, 100))
    assert "the best of 4 tiles has data in 40 % of its pixels, the whole map in 10 %; allowed: 50 %" in str(error)
    check(100, 100, "train", 0.0, size_px=50)
