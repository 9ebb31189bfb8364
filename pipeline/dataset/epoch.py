"""One epoch of a data set, as `simulate` makes it, and its tiles. A pure function of (config, seed, index)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.annotate import block_annotations
from pipeline.change.difference import SurfaceRaster, cast_raster, difference, surface_raster
from pipeline.change.tiles import Tile, tiles
from pipeline.config.simulation import SimulationConfig
from pipeline.dataset.config import DatasetConfig
from pipeline.dataset.plan import (
    PlannedEpoch,
    blocks_on,
    check_filled,
    random_of_epoch,
    random_of_reference,
    random_of_wall,
    region,
    simulation_of,
)
from pipeline.report.progress import Progress
from pipeline.run.epoch import LaterEpoch, ReferenceEpoch, observe_epoch, observe_reference
from pipeline.run.site import SensorSite, prepare_site
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL

_DRAWS = 5
"""Times that an epoch's blocks are drawn before the set-up is at fault."""


@dataclass(frozen=True)
class EpochStage:
    """What the epochs of one wall, sensor, noise and reference share. true: raster of the untouched wall, on request; spacing_m:
    of ray-traced samples on the wall, None of a surface of the wall's own vertices."""

    site: SensorSite
    reference: ReferenceEpoch
    spacing_m: float | None
    true: SurfaceRaster | None


@dataclass(frozen=True)
class EpochTile:
    """A tile of an epoch with its annotations (COCO's, without ids) and, on request, the true difference (size, size), m."""

    tile: Tile
    annotations: list[dict[str, Any]]
    truth: NDArray[np.float32] | None


@dataclass(frozen=True)
class MadeEpoch:
    """record: what describes the epoch (JSON types); tiles: those that belong to the set."""

    record: dict[str, Any]
    tiles: list[EpochTile]


class Stages:
    """The stage that a worker has set up: wall, frame, ray-tracing scene and reference epoch.

    One at a time: plans keep epochs of a stage together, and a stage takes a good part of a worker's memory. made: how many so
    far.
    """

    def __init__(self, config: DatasetConfig) -> None:
        self._config = config
        self._kept: EpochStage | None = None
        self._key: object = None
        self.made = 0

    def of(self, epoch: PlannedEpoch, progress: Progress) -> EpochStage:
        """The stage of an epoch; a new one takes the place of the last."""
        if self._kept is None or self._key != epoch.stage:
            self._kept = None  # before the new one is made, so that there are never two
            self._kept, self._key = _set_up(self._config, epoch, progress), epoch.stage
            self.made += 1
        return self._kept


def _set_up(config: DatasetConfig, epoch: PlannedEpoch, progress: Progress) -> EpochStage:
    simulation = simulation_of(config, epoch)
    with progress.stage("wall"):
        site = prepare_site(simulation, epoch.sensor, random_of_wall(config, epoch.wall))
    reference = observe_reference(simulation, site, random_of_reference(config, epoch), progress)
    true = cast_raster(reference.caster, reference.raster.grid) if config.truth else None
    grid, samples = reference.raster.grid, len(reference.surface.vertices)
    by_vertices = reference.seen is not None and reference.seen.vertices is not None
    spacing = None if by_vertices else float(np.sqrt(grid.width * grid.height / samples) * grid.gsd)
    return EpochStage(site, replace(reference, seen=None), spacing, true)


def make_epoch(config: DatasetConfig, epoch: PlannedEpoch, stages: Stages, progress: Progress) -> MadeEpoch:
    """Carve, observe and cut an epoch of the plan.

    Raises InputError for what is wrong with the wall, the blocks or the tiles, naming the epoch.
    """
    try:
        stage = stages.of(epoch, progress)
        grid = stage.reference.raster.grid
        where = region(epoch.split, config.validation_region, grid, config.tiles)
        check_filled(epoch.split, where, grid, config.tiles)
        simulation = with_count(simulation_of(config, epoch), blocks_on(config, epoch.size, grid))
        found, draw = _observed(config, simulation, epoch, stage, progress)
    except InputError as error:
        raise InputError(str(error), where=epoch.name) from None
    with progress.stage("tiles"):
        truth = None if stage.true is None else true_difference(stage.true, found)
        cut = [tile for tile in _cut(config, found, grid, truth) if where.holds(tile.tile.column, config.tiles.size_px)]
    if not cut:
        raise no_tile(config, epoch, found.difference, grid)
    return MadeEpoch({**_record(config, epoch, found, simulation), "draw": draw, "spacing_m": stage.spacing_m}, cut)


def no_tile(config: DatasetConfig, epoch: PlannedEpoch, values: NDArray[np.float32], grid: Grid) -> InputError:
    """What to say where the wall fills the tiles, but the sensor does not. values: (h, w) of the difference map, m."""
    every = config.tiles.model_copy(update={"minimum_valid_share": 0.0})
    where = region(epoch.split, config.validation_region, grid, config.tiles)
    blank = np.zeros(values.shape, np.int32)
    cut = [tile for tile in tiles(values, blank, grid, every) if where.holds(tile.column, every.size_px)]
    best, whole = max(tile.valid_share for tile in cut), np.count_nonzero(np.isfinite(values)) / values.size
    return InputError(
        f"no tile has enough data: the fullest of {len(cut)} has it in {100 * best:.0f} % of its pixels, "
        f"the whole map in {100 * whole:.0f} %",
        where=epoch.name,
        allowed=f"{100 * config.tiles.minimum_valid_share:.0f} % (tiles.minimum_valid_share)",
        remedy="let the sensor see more of the wall (place, field of view), use a coarser difference.gsd_m, or lower the share",
    )


def _observed(
    config: DatasetConfig, simulation: SimulationConfig, epoch: PlannedEpoch, stage: EpochStage, progress: Progress
) -> tuple[LaterEpoch, int]:
    """The epoch, and the draw that it came from: where blocks find no room all are drawn anew, a few times."""
    for draw in range(1, _DRAWS + 1):
        try:
            random = random_of_epoch(config, epoch, draw)
            return observe_epoch(simulation, stage.site, stage.reference, epoch.number, random, progress), draw
        except InputError:
            if draw == _DRAWS:
                raise
    raise AssertionError("the last draw has returned or raised")


def with_count(simulation: SimulationConfig, count: int) -> SimulationConfig:
    return simulation.model_copy(update={"rockfall": simulation.rockfall.model_copy(update={"count": count})})


def true_difference(wall: SurfaceRaster, epoch: LaterEpoch) -> NDArray[np.float32]:
    """(h, w) m, NaN where there is no wall: the wall before minus the wall after, without any sensor."""
    return difference(wall, surface_raster(epoch.carved.mesh, wall.grid))


def _cut(config: DatasetConfig, epoch: LaterEpoch, grid: Grid, truth: NDArray[np.float32] | None) -> Iterator[EpochTile]:
    labels = np.where(np.isnan(epoch.difference), np.int32(WALL), epoch.raster.block)
    whole = np.bincount(labels.ravel(), minlength=len(epoch.blocks) + 1)
    size = config.tiles.size_px
    for tile in tiles(epoch.difference, labels, grid, config.tiles):
        annotations = [_described(each, epoch.blocks, whole, config) for each in block_annotations(tile.block, config.annotation)]
        yield EpochTile(tile, annotations, None if truth is None else _window(truth, tile.row, tile.column, size))


def _window(raster: NDArray[np.float32], row: int, column: int, size: int) -> NDArray[np.float32]:
    """A square of a raster, NaN beyond its edge."""
    window = raster[row : row + size, column : column + size]
    return np.pad(window, [(0, size - length) for length in window.shape], constant_values=np.nan)


def _described(
    annotation: dict[str, Any], blocks: list[dict[str, Any]], whole: NDArray[np.intp], config: DatasetConfig
) -> dict[str, Any]:
    """A COCO annotation with what is known of its block; lengths in m, volumes in m3."""
    block = blocks[annotation["block"] - 1]
    ratio = block["signal_to_noise"]
    return annotation | {
        "shape": block["shape"],
        "size_m": [round(value, 5) for value in block["size_m"]],
        "depth_m": round(block["measured_mean_depth_m"], 5),
        "volume_m3": round(block["volume_m3"], 8),
        "measured_volume_m3": round(block["measured_volume_m3"], 8),
        "signal_to_noise": ratio,
        "ignore": int(ratio is not None and ratio < config.annotation.ignore_below),
        "share_in_tile": round(annotation["area"] / int(whole[annotation["block"]]), 4),
    }


def _record(config: DatasetConfig, epoch: PlannedEpoch, found: LaterEpoch, simulation: SimulationConfig) -> dict[str, Any]:
    return {
        "epoch": epoch.to_dict(),
        "seed": config.seed,
        "blocks": simulation.rockfall.count,
        "registration": None if found.registration is None else found.registration.to_dict(),
        "outside_blocks": found.statistics.outside.to_dict(),
        "inside_blocks": found.statistics.inside.to_dict(),
    }
