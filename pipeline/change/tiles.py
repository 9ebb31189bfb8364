"""Square tiles of a raster, for networks that take small images."""

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


class TileConfig(Config):
    """How a raster is cut."""

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
    """A square of a raster; pixels beyond the raster's edge are NaN and WALL.

    row, column: its top-left pixel in the raster; grid: its place on the wall; values: (size, size) float32; block: (size, size)
    int32; valid_share: the share of its pixels that have data.
    """

    row: int
    column: int
    grid: Grid
    values: NDArray[np.float32]
    block: IntArray
    valid_share: float

    @property
    def name(self) -> str:
        """Its place as a word for file names, unique within the raster: r00512_c01024."""
        return f"r{self.row:05d}_c{self.column:05d}"


def tiles(values: NDArray[np.float32], block: IntArray, grid: Grid, config: TileConfig) -> Iterator[Tile]:
    """Cut a raster (h, w) with its labels (h, w) row by row, leaving out tiles with too few data.

    Every pixel falls into a tile; the last row and column of tiles reach beyond the raster and are filled with NaN, so that all
    tiles are of one size and, without overlap, no pixel is in two of them. Raises InputError where the shapes differ, and for
    more than MOST_TILES.
    """
    if not values.shape == block.shape == grid.shape:
        raise InputError(f"raster {values.shape}, labels {block.shape} and grid {grid.shape} differ in shape", where="tiles")
    size = config.size_px
    count = len(starts_of_tiles(grid.height, config)) * len(starts_of_tiles(grid.width, config))
    if count > MOST_TILES:
        problem = f"{count:,} tiles of a map of {grid.width} x {grid.height} px"
        raise InputError(problem, where="tiles", allowed=f"up to {MOST_TILES:,}", remedy="raise size_px or lower overlap_px")
    for row in starts_of_tiles(grid.height, config):
        for column in starts_of_tiles(grid.width, config):
            window = np.s_[row : row + size, column : column + size]
            valid_share = np.count_nonzero(~np.isnan(values[window])) / size**2
            if valid_share >= config.minimum_valid_share:
                place = Grid(grid.x_min + column * grid.gsd, grid.y_max - row * grid.gsd, grid.gsd, size, size)
                missing = [(0, size - length) for length in values[window].shape]
                cut = np.pad(values[window], missing, constant_values=np.nan)
                labels = np.pad(block[window], missing, constant_values=WALL)
                yield Tile(row, column, place, cut, labels, valid_share)


def starts_of_tiles(length: int, config: TileConfig) -> range:
    """The first pixels of the tiles along a side of `length` pixels: no tile lies wholly within the one before it."""
    return range(0, max(length - config.overlap_px, 1), config.size_px - config.overlap_px)
