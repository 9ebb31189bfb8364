"""Cut a raster into square tiles, for networks that take small images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from scene.common.config import Config
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, IntArray

MOST_TILES = 100_000
"""Most tiles of one raster."""


class TileConfig(Config):
    """How a difference map is cut into square tiles for a detector."""

    size_px: int = Field(512, ge=8, le=65_536, description="side of a tile")
    overlap_px: int = Field(0, ge=0, description="pixels that neighbouring tiles share; less than size_px")
    minimum_valid_share: float = Field(0.5, ge=0, le=1, description="tiles with a smaller share of pixels with data are left out")

    @model_validator(mode="after")
    def _check_overlap(self) -> TileConfig:
        if self.overlap_px >= self.size_px:
            raise ValueError(f"overlap_px must be less than size_px ({self.size_px})")
        return self


@dataclass(frozen=True)
class Tile:
    """A square cut out of a difference map or another raster; pixels beyond the raster's edge are NaN and have no block.

    Attributes
    ----------
    row, column : int
        Top-left pixel in the raster.
    grid : Grid
        Position on the wall.
    values : (size, size) float32 array
        Values of the raster.
    block : (size, size) int32 array
        Label of the fallen block at each pixel, 0 for none.
    valid_share : float
        Share of its pixels that have data.
    """

    row: int
    column: int
    grid: Grid
    values: NDArray[np.float32]
    block: IntArray
    valid_share: float

    @property
    def name(self) -> str:
        """Position of the tile as a word for file names, unique within the raster.

        r00512_c01024 begins at row 512 and column 1024.
        """
        return f"r{self.row:05d}_c{self.column:05d}"


def tiles(values: NDArray[np.float32], block: IntArray, grid: Grid, config: TileConfig) -> Iterator[Tile]:
    """Cut a raster row by row into square tiles for a detector, leaving out those with too few data.

    Every pixel belongs to a tile. The last row and column of tiles extend beyond the raster and are filled with NaN, so that
    all tiles have the same size and, without overlap, no pixel is in two of them.

    Parameters
    ----------
    values, block : (h, w) arrays
        The raster, NaN without data, and the labels of the fallen blocks, 0 for none.
    grid : Grid
        Position of the raster's pixels.
    config : TileConfig
        Size and overlap of the tiles, and their smallest share of pixels with data.

    Raises
    ------
    InputError
        If the shapes differ, or for more tiles than are allowed.
    """
    if not values.shape == block.shape == grid.shape:
        raise InputError(
            f"raster {values.shape}, labels {block.shape} and grid {grid.shape} differ in shape",
            where="tiles",
            remedy="give arrays of the shape of the grid",
        )
    size = config.size_px
    count = len(tile_starts(grid.height, config)) * len(tile_starts(grid.width, config))
    if count > MOST_TILES:
        raise InputError(
            f"the config cuts a map of {grid.width} x {grid.height} px into {count:,} tiles",
            where="tiles",
            allowed=f"up to {MOST_TILES:,}",
            remedy="raise size_px or lower overlap_px",
        )
    for row in tile_starts(grid.height, config):
        for column in tile_starts(grid.width, config):
            window = np.s_[row : row + size, column : column + size]
            valid_share = np.count_nonzero(~np.isnan(values[window])) / size**2
            if valid_share >= config.minimum_valid_share:
                place = Grid(grid.x_min + column * grid.gsd, grid.y_max - row * grid.gsd, grid.gsd, size, size)
                missing = [(0, size - length) for length in values[window].shape]
                cut = np.pad(values[window], missing, constant_values=np.nan)
                labels = np.pad(block[window], missing, constant_values=WALL)
                yield Tile(row, column, place, cut, labels, valid_share)


def tile_starts(length: int, config: TileConfig) -> range:
    """Return the first pixel of each tile along a side of a raster, `length` px long.

    config: size and overlap of the tiles. No tile lies entirely within the one before it.
    """
    return range(0, max(length - config.overlap_px, 1), config.size_px - config.overlap_px)
