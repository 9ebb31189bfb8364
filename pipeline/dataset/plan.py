"""From a data set's config to the list of its epochs, and which tiles of an epoch belong to the set."""

from __future__ import annotations

from dataclasses import asdict, dataclass
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
    """One epoch of a data set. index: in the plan; number: among the epochs of its combination and split, from 1;
    reference: which of the reference epochs it is compared with."""

    index: int
    split: Split
    sensor: SensorName
    wall: str
    noise: str
    size: str
    number: int
    reference: int

    @property
    def name(self) -> str:
        """A word for file names, unique in the set."""
        return f"{self.wall}_{self.sensor}_{self.noise}_{self.size}_{self.split}{self.number:04d}"

    @property
    def stage(self) -> tuple[SensorName, str, str, int]:
        """What epochs share that have the same reference epoch: sensor, wall, noise, number of the reference."""
        return self.sensor, self.wall, self.noise, self.reference

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def planned_epochs(config: DatasetConfig) -> list[PlannedEpoch]:
    """All epochs of the set, those that share a reference epoch one after the other."""
    found = [
        PlannedEpoch(0, split, sensor, wall, noise, size, number, (number - 1) % config.references + 1)
        for part in config.parts
        for sensor in config.sensors
        for wall in part.walls
        for noise in part.noise
        for size in part.sizes
        for split in SPLITS
        for number in range(1, getattr(part, split) + 1)
    ]
    order = {stage: rank for rank, stage in enumerate(dict.fromkeys(epoch.stage[:3] for epoch in found))}
    found.sort(key=lambda epoch: (order[epoch.stage[:3]], epoch.reference))
    return [PlannedEpoch(**{**epoch.to_dict(), "index": index}) for index, epoch in enumerate(found)]


def simulation_of(config: DatasetConfig, epoch: PlannedEpoch) -> SimulationConfig:
    """The simulation that an epoch is an epoch of; the number of its blocks follows when the wall's area is known."""
    level = config.noise[epoch.noise].of(epoch.sensor)
    if level is None:  # the config's own check has been here
        raise InputError(f"has no model of {epoch.sensor}", where=f"noise.{epoch.noise}")
    wall = config.walls[epoch.wall]
    if epoch.sensor == "tls" and wall.reconstruction == "vertices":  # of the stereo pair alone
        wall = wall.model_copy(update={"reconstruction": "direct"})
    changes = {"seed": config.seed, "sensor": (level.on(epoch.wall),), "rockfall": config.sizes[epoch.size].rockfall}
    return wall.model_copy(update={**changes, "tiles": config.tiles, "annotation": config.annotation})


def blocks_on(config: DatasetConfig, size: str, grid: Grid) -> int:
    """How many blocks fall from a wall whose difference maps have the pixels of `grid`; raises InputError for too many."""
    area = grid.width * grid.height * grid.gsd**2
    count = config.sizes[size].blocks_per_m2 * area
    if count > MOST_BLOCKS:
        problem = f"asks for {count:,.3g} blocks on {area:,.0f} m2"
        allowed = f"up to {MOST_BLOCKS / area:.3g}, {MOST_BLOCKS:,} blocks"
        raise InputError(problem, where=f"sizes.{size}.blocks_per_m2", allowed=allowed)
    return max(1, round(count))


def random_of_wall(config: DatasetConfig, wall: str) -> KeyedRandom:
    """Of a wall without a seed of its own, and of its texture: the same for all sensors, noise and sizes."""
    return KeyedRandom(config.seed).child("dataset", "wall", wall)


def random_of_reference(config: DatasetConfig, epoch: PlannedEpoch) -> KeyedRandom:
    return KeyedRandom(config.seed).child("dataset", "reference", *epoch.stage)


def random_of_epoch(config: DatasetConfig, epoch: PlannedEpoch, draw: int) -> KeyedRandom:
    """Of an epoch's blocks, noise and registration; draw: counts from 1, where blocks find no room and are drawn anew."""
    path = epoch.wall, epoch.sensor, epoch.noise, epoch.size, epoch.split
    return KeyedRandom(config.seed).child("dataset", "epoch", *path, "draw", draw)


@dataclass(frozen=True)
class Region:
    """The columns of pixels, [first, end), in which a tile must lie."""

    first: int
    end: float

    def holds(self, column: int, size: int) -> bool:
        """Whether a tile of `size` px from `column` on lies in it."""
        return self.first <= column and column + size <= self.end


def region(split: Split, share: float, grid: Grid, config: TileConfig) -> Region:
    """Where the tiles of a split may lie on a wall with the difference maps `grid`.

    Training has the columns of tiles from the left, validation those at the right end that make up about `share`; strata run
    along the wall, so both see all of them. Tests use the whole wall. Raises InputError where a wall has too few columns.
    """
    step = config.size_px - config.overlap_px
    columns = len(tile_starts(grid.width, config))
    if split == "test" or share == 0:
        return Region(0, float("inf"))
    kept = round(share * columns)
    if not 0 < kept < columns:
        raise InputError(
            f"{share:g} of {columns} columns of tiles is {'none' if kept == 0 else 'all'} of them, as the difference maps are "
            f"{grid.width} px wide (gsd {grid.gsd:.3g} m) and a tile {config.size_px} px",
            where="validation_region",
            allowed="0, or a share that leaves both training and validation a column",
            remedy="use smaller tiles, a finer gsd or a longer wall",
        )
    boundary = (columns - kept) * step
    return Region(0, boundary) if split == "train" else Region(boundary, float("inf"))


def check_filled(split: Split, where: Region, grid: Grid, config: TileConfig) -> None:
    """Raise InputError where no tile of a split can have enough pixels with data, as the wall or its part is too small for one.

    where: the split's columns on a wall with the difference maps `grid`.
    """
    filled, whole = (_most_filled(part, grid, config) for part in (where, Region(0, float("inf"))))
    if filled >= config.minimum_valid_share and filled > 0:
        return
    wall = f"the difference maps are {grid.width} x {grid.height} px (gsd {grid.gsd:.3g} m)"
    tile = f"a tile of {config.size_px} px {{}}, and tiles.minimum_valid_share is {config.minimum_valid_share:g}"
    if whole < config.minimum_valid_share:
        raise InputError(
            f"{wall}, which fill {tile.format(f'to {100 * whole:.0f} % at most')}",
            where="tiles",
            remedy="use smaller tiles (tiles.size_px), a finer difference.gsd_m or a larger wall",
        )
    columns = f"{max(min(where.end, grid.width) - where.first, 0):.0f} px"
    part = "the validation region" if split == "val" else f"what the validation region leaves to {split}"
    raise InputError(
        f"{wall}, and {part} is {columns} wide: it fills {tile.format(f'to {100 * filled:.0f} % at most')}",
        where="validation_region",
        remedy="change the share, or use smaller tiles (tiles.size_px), a finer difference.gsd_m or a longer wall",
    )


def _most_filled(where: Region, grid: Grid, config: TileConfig) -> float:
    """The largest share of a tile within a region that lies on the wall, 0 where no tile lies in the region."""
    size = config.size_px
    starts = (column for column in tile_starts(grid.width, config) if where.holds(column, size))
    width = max((min(size, grid.width - column) for column in starts), default=0)
    return width * min(size, grid.height) / size**2
