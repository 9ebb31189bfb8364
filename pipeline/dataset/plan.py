"""Plan a data set: the list of its epochs, the simulation of each, and which tiles of an epoch belong to the set."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from pipeline.change.tiles import TileConfig, tile_starts
from pipeline.config.simulation import SensorName, SimulationConfig
from pipeline.dataset.config import DatasetConfig
from scene.blocks.block import MOST_BLOCKS
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")


@dataclass(frozen=True)
class PlannedEpoch:
    """One epoch that a data set has or will have.

    Attributes
    ----------
    index : Index in the plan.
    split : "train", "val" or "test".
    sensor, wall, noise, size : Names of the sensor, the wall, the noise level and the size class that are combined in it.
    number : Number from 1 among the epochs of this combination and split; on a wall with a time series, the number of the series.
    reference : Number of the reference epoch that it is compared with, from 1.
    step : Number of the epoch in its time series, from 1; 0 on a wall without one.
    """

    index: int
    split: Split
    sensor: SensorName
    wall: str
    noise: str
    size: str
    number: int
    reference: int
    step: int = 0

    @property
    def name(self) -> str:
        """A word that names the epoch in file names, unique in the data set."""
        step = f"e{self.step:04d}" if self.step else ""
        return f"{self.wall}_{self.sensor}_{self.noise}_{self.size}_{self.split}{self.number:04d}{step}"

    @property
    def stage(self) -> tuple[SensorName, str, str, int]:
        """Key of the set-up that epochs with one reference epoch share: sensor, wall, noise level, number of the reference."""
        return self.sensor, self.wall, self.noise, self.reference

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of the planned epoch as a dictionary, for its record; `step` only if it is one of a series."""
        return {key: value for key, value in asdict(self).items() if key != "step" or value}


def planned_epochs(config: DatasetConfig) -> list[PlannedEpoch]:
    """List all epochs that a data set's config asks for, those that share a reference epoch next to each other.

    On a wall with a time series, the config's numbers of epochs are numbers of series. All epochs of each series but its
    reference are listed.
    """
    found = [
        PlannedEpoch(0, split, sensor, wall, noise, size, number, (number - 1) % config.references + 1, step)
        for part in config.parts
        for sensor in config.sensors
        for wall in part.walls
        for noise in part.noise
        for size in part.sizes
        for split in SPLITS
        for number in range(1, getattr(part, split) + 1)
        for step in config.steps(wall)
    ]
    order = {stage: rank for rank, stage in enumerate(dict.fromkeys(epoch.stage[:3] for epoch in found))}
    found.sort(key=lambda epoch: (order[epoch.stage[:3]], epoch.reference))
    return [replace(epoch, index=index) for index, epoch in enumerate(found)]


def simulation_of(config: DatasetConfig, epoch: PlannedEpoch) -> SimulationConfig:
    """Return the simulation config of a data set's epoch.

    config: of the data set. epoch: which one. The number of its blocks is set later, when the wall's area is known.
    """
    level = config.noise[epoch.noise].of(epoch.sensor)
    if level is None:  # the config's validation excludes this
        raise InputError(
            f"the noise level has no model for the {epoch.sensor} sensor",
            where=f"noise.{epoch.noise}",
            remedy=f"add `{epoch.sensor}: {{model: ...}}`, or leave the sensor out of `sensors`",
        )
    wall = config.walls[epoch.wall]
    if epoch.sensor == "tls" and wall.reconstruction == "vertices":  # stereo only
        wall = wall.model_copy(update={"reconstruction": "direct"})
    changes = {"seed": config.seed, "sensor": (level.on(epoch.wall),), "rockfall": config.sizes[epoch.size].rockfall}
    return wall.model_copy(update={**changes, "tiles": config.tiles, "annotation": config.annotation})


def block_count(config: DatasetConfig, size: str, grid: Grid) -> int:
    """Return the number of blocks that fall from a wall.

    Parameters
    ----------
    config : Config of the set.
    size : Name of the size class, which gives the blocks per area.
    grid : Raster of the wall's difference maps, which gives the area.

    Raises
    ------
    InputError
        If there would be too many.
    """
    area = grid.width * grid.height * grid.gsd**2
    count = config.sizes[size].blocks_per_m2 * area
    if count > MOST_BLOCKS:
        raise InputError(
            f"this density gives {count:,.3g} blocks on {area:,.0f} m2",
            where=f"sizes.{size}.blocks_per_m2",
            allowed=f"up to {MOST_BLOCKS / area:.3g} per m2, which gives {MOST_BLOCKS:,} blocks",
            remedy="lower blocks_per_m2",
        )
    return max(1, round(count))


def random_of_wall(config: DatasetConfig, wall: str) -> KeyedRandom:
    """Return the random source for the shape of a wall whose config gives no seed, and for its texture.

    config: of the data set. wall: name of the wall. The source is the same for all sensors, noise levels and sizes.
    """
    return KeyedRandom(config.seed).child("dataset", "wall", wall)


def random_of_reference(config: DatasetConfig, epoch: PlannedEpoch) -> KeyedRandom:
    """Return the random source for simulating the reference epoch with which a data set's epoch is compared.

    config: of the data set. epoch: the epoch that is compared.
    """
    return KeyedRandom(config.seed).child("dataset", "reference", *epoch.stage)


def random_of_epoch(config: DatasetConfig, epoch: PlannedEpoch, draw: int) -> KeyedRandom:
    """Return the random source for the blocks, the noise and the registration of a data set's epoch.

    config: of the data set. epoch: which one. draw: number of the attempt, from 1; blocks that find no room are drawn again
    from another source.
    """
    path = epoch.wall, epoch.sensor, epoch.noise, epoch.size, epoch.split
    return KeyedRandom(config.seed).child("dataset", "epoch", *path, "draw", draw)


def random_of_series(config: DatasetConfig, epoch: PlannedEpoch) -> KeyedRandom:
    """Return the random source for the rockfalls, the conditions and the measurements of a data set's time series.

    config: of the data set. epoch: any epoch of the series; the source is the same for all of them.
    """
    path = epoch.wall, epoch.sensor, epoch.noise, epoch.size, epoch.split
    return KeyedRandom(config.seed).child("dataset", "series", *path, epoch.number)


@dataclass(frozen=True)
class TileRegion:
    """Columns of a difference map, [first, end) px, in which the tiles of a split must lie."""

    first: int
    end: float

    def holds(self, column: int, size: int) -> bool:
        """Whether a tile of `size` px that begins at `column` lies in the columns of its split."""
        return self.first <= column and column + size <= self.end


def tile_region(split: Split, share: float, grid: Grid, config: TileConfig) -> TileRegion:
    """Return the region of a split's tiles on a wall, so that training and validation see different parts of it.

    Training uses the columns of tiles from the left, validation those at the right end. Rock strata run along the wall, so both
    parts show all of them. Tests use the whole wall.

    Parameters
    ----------
    split : "train", "val" or "test".
    share : Approximate share of the columns for validation; 0: both use the whole wall.
    grid : Raster of the difference maps.
    config : Size and overlap of the tiles.

    Raises
    ------
    InputError
        If the wall has too few columns to divide.
    """
    step = config.size_px - config.overlap_px
    columns = len(tile_starts(grid.width, config))
    if split == "test" or share == 0:
        return TileRegion(0, float("inf"))
    kept = round(share * columns)
    if not 0 < kept < columns:
        raise InputError(
            f"a share of {share:g} of {columns} columns of tiles rounds to {'none' if kept == 0 else 'all'}: the "
            f"difference maps are {grid.width} px wide (gsd {grid.gsd:.3g} m) and a tile {config.size_px} px",
            where="validation_region",
            allowed="0, or a share that gives training and validation at least one column",
            remedy="use smaller tiles (tiles.size_px), a finer difference.gsd_m or a longer wall",
        )
    boundary = (columns - kept) * step
    return TileRegion(0, boundary) if split == "train" else TileRegion(boundary, float("inf"))


def check_tiles_filled(split: Split, where: TileRegion, grid: Grid, config: TileConfig) -> None:
    """Raise InputError if no tile of a split can have enough pixels with data, because the wall or the region is too small.

    Parameters
    ----------
    split : "train", "val" or "test".
    where : Columns of the difference map that the split uses.
    grid : Raster of the difference maps.
    config : Size of the tiles and their smallest share of data.
    """
    filled, whole = (_most_filled(part, grid, config) for part in (where, TileRegion(0, float("inf"))))
    if filled >= config.minimum_valid_share and filled > 0:
        return
    wall = f"the difference maps are {grid.width} x {grid.height} px (gsd {grid.gsd:.3g} m)"
    least = f"tiles.minimum_valid_share is {config.minimum_valid_share:g}"
    if whole < config.minimum_valid_share:
        raise InputError(
            f"{wall}, which fill a tile of {config.size_px} px to {100 * whole:.0f} % at most, and {least}",
            where="tiles",
            remedy="use smaller tiles (tiles.size_px), a finer difference.gsd_m or a larger wall",
        )
    columns = f"{max(min(where.end, grid.width) - where.first, 0):.0f} px"
    part = "the validation region" if split == "val" else f"what the validation region leaves to {split}"
    raise InputError(
        f"{wall}, and {part} is {columns} wide: it fills a tile of {config.size_px} px "
        f"to {100 * filled:.0f} % at most, and {least}",
        where="validation_region",
        remedy=f"{'raise' if split == 'val' else 'lower'} validation_region, the share of the wall for validation, or use "
        "smaller tiles (tiles.size_px), a finer difference.gsd_m or a longer wall",
    )


def _most_filled(where: TileRegion, grid: Grid, config: TileConfig) -> float:
    """Return the largest share of a tile in a region that the wall covers; 0 if no tile fits."""
    size = config.size_px
    starts = (column for column in tile_starts(grid.width, config) if where.holds(column, size))
    width = max((min(size, grid.width - column) for column in starts), default=0)
    return width * min(size, grid.height) / size**2
