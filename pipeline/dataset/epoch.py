"""Simulate one epoch of a data set and cut it into tiles. The result depends only on config, seed and index of the epoch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
    block_count,
    check_tiles_filled,
    random_of_epoch,
    random_of_reference,
    random_of_wall,
    simulation_of,
    tile_region,
)
from pipeline.dataset.series import SeriesWalk, annotated, observe_step, reference_site
from pipeline.report.progress import Progress
from pipeline.run.epoch import LaterEpoch, ReferenceEpoch, observe_epoch, observe_reference
from pipeline.run.site import SensorSite, prepare_site
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, IntArray

_DRAWS = 5
"""Number of times that an epoch's blocks are drawn if they find no room."""


@dataclass(frozen=True)
class EpochStage:
    """Set-up shared by the epochs of a data set with the same wall, sensor, noise level and reference epoch.

    Attributes
    ----------
    site : Wall and sensor.
    reference : The reference epoch, with which the others are compared.
    spacing_m : Spacing of ray-traced samples on the wall, m; None if the surface consists of the wall's own vertices.
    true : Raster of the untouched wall; None unless the config asks for true differences.
    walk : Follows the wall through the time series of its config; unused without one.
    """

    site: SensorSite
    reference: ReferenceEpoch
    spacing_m: float | None
    true: SurfaceRaster | None
    walk: SeriesWalk


@dataclass(frozen=True)
class EpochTile:
    """A tile of an epoch's difference map for a data set.

    tile: the pixels. annotations: of its fallen blocks, as COCO's, without ids. truth: the true difference (size, size), m;
    None unless the config asks for it.
    """

    tile: Tile
    annotations: list[dict[str, Any]]
    truth: NDArray[np.float32] | None


@dataclass(frozen=True)
class MadeEpoch:
    """A simulated epoch of a data set, not yet written.

    record: its description (JSON types). tiles: those tiles of its difference map that belong to the set.
    """

    record: dict[str, Any]
    tiles: list[EpochTile]


class StageCache:
    """Keeps the set-up of the last simulated epoch (wall, frame, ray-tracing scene and reference epoch) for the next ones.

    Epochs of the same wall, sensor, noise and reference share this set-up, called a stage. The cache keeps only one, because a
    stage takes much of a worker's memory, and plans put the epochs of a stage next to each other. `made` counts the stages set
    up so far.
    """

    def __init__(self, config: DatasetConfig) -> None:
        self._config = config
        self._kept: EpochStage | None = None
        self._key: object = None
        self.made = 0

    def of(self, epoch: PlannedEpoch, progress: Progress) -> EpochStage:
        """Return the stage (wall, scene, reference epoch) that an epoch of the data set needs.

        A new stage is set up if the last call was for another one. progress: receives the progress of setting it up.
        """
        if self._kept is None or self._key != epoch.stage:
            self._kept = None  # free the memory before the new one is made
            self._kept, self._key = _set_up(self._config, epoch, progress), epoch.stage
            self.made += 1
        return self._kept


def _set_up(config: DatasetConfig, epoch: PlannedEpoch, progress: Progress) -> EpochStage:
    """Prepare the site and observe the reference epoch."""
    simulation = simulation_of(config, epoch)
    with progress.stage("wall"):
        site = prepare_site(simulation, epoch.sensor, random_of_wall(config, epoch.wall))
    before = reference_site(config, epoch, site)
    reference = observe_reference(simulation, before, random_of_reference(config, epoch), progress)
    true = cast_raster(reference.caster, reference.raster.grid) if config.truth else None
    grid, samples = reference.raster.grid, len(reference.surface.vertices)
    by_vertices = reference.seen is not None and reference.seen.vertices is not None
    spacing = None if by_vertices else float(np.sqrt(grid.width * grid.height / samples) * grid.gsd)
    return EpochStage(site, replace(reference, seen=None), spacing, true, SeriesWalk(config, site))


def make_epoch(config: DatasetConfig, epoch: PlannedEpoch, stages: StageCache, progress: Progress) -> MadeEpoch:
    """Simulate a planned epoch of a data set and cut its difference map into tiles.

    Parameters
    ----------
    config : Config of the set.
    epoch : The planned epoch.
    stages : Keeps the set-up (wall, reference epoch) between epochs.
    progress : Receives the progress.

    Raises
    ------
    InputError
        If the wall, the blocks or the tiles cannot be made; it names the epoch.
    """
    try:
        stage = stages.of(epoch, progress)
        grid = stage.reference.raster.grid
        where = tile_region(epoch.split, config.validation_region, grid, config.tiles)
        check_tiles_filled(epoch.split, where, grid, config.tiles)
        found, shown, draw = _observed(config, epoch, stage, progress)
    except InputError as error:
        raise InputError(f"this epoch of the data set could not be simulated: {error}", where=epoch.name) from None
    with progress.stage("tiles"):
        truth = None if stage.true is None else true_difference(stage.true, found)
        cut = [tile for tile in _cut(config, found, shown, truth) if where.holds(tile.tile.column, config.tiles.size_px)]
    if not cut:
        raise no_tile_error(config, epoch, found.difference, grid)
    return MadeEpoch({**_record(config, epoch, found), "draw": draw, "spacing_m": stage.spacing_m}, cut)


def no_tile_error(config: DatasetConfig, epoch: PlannedEpoch, values: NDArray[np.float32], grid: Grid) -> InputError:
    """Return the error for an epoch whose difference map has too little data for any tile.

    Parameters
    ----------
    config : Config of the set.
    epoch : The planned epoch.
    values : (h, w) its difference map, m.
    grid : Raster of the map.
    """
    every = config.tiles.model_copy(update={"minimum_valid_share": 0.0})
    where = tile_region(epoch.split, config.validation_region, grid, config.tiles)
    blank = np.zeros(values.shape, np.int32)
    cut = [tile for tile in tiles(values, blank, grid, every) if where.holds(tile.column, every.size_px)]
    best, whole = max(tile.valid_share for tile in cut), np.count_nonzero(np.isfinite(values)) / values.size
    return InputError(
        f"no tile has enough data: the best of {len(cut)} tiles has data in {100 * best:.0f} % of its pixels, "
        f"the whole map in {100 * whole:.0f} %",
        where=epoch.name,
        allowed=f"{100 * config.tiles.minimum_valid_share:.0f} % (tiles.minimum_valid_share)",
        remedy="show the sensor more of the wall (place, field of view), use a coarser difference.gsd_m, or lower the share",
    )


@dataclass(frozen=True)
class _Annotated:
    """What is annotated in an epoch: the label of each pixel, (h, w), 0 for none, and the record of each label's block."""

    labels: IntArray
    blocks: Mapping[int, dict[str, Any]]


def _observed(
    config: DatasetConfig, epoch: PlannedEpoch, stage: EpochStage, progress: Progress
) -> tuple[LaterEpoch, _Annotated, int]:
    """Simulate the epoch; return it with what is annotated in it, and the number of the draw.

    Without a time series, blocks that find no room are drawn again.
    """
    simulation = simulation_of(config, epoch)
    if simulation.series is not None:
        found, scene = observe_step(stage.walk, stage.reference, epoch, progress)
        return found, _Annotated(*annotated(found, scene, simulation.series.kinds)), 1
    simulation = with_count(simulation, block_count(config, epoch.size, stage.reference.raster.grid))
    for draw in range(1, _DRAWS + 1):
        try:
            random = random_of_epoch(config, epoch, draw)
            found = observe_epoch(simulation, stage.site, stage.reference, epoch.number, random, progress)
            return found, _Annotated(found.raster.block, dict(enumerate(found.blocks, start=1))), draw
        except InputError:
            if draw == _DRAWS:
                raise
    raise AssertionError("the last draw has returned or raised")


def with_count(simulation: SimulationConfig, count: int) -> SimulationConfig:
    """Return a simulation's config with `count` as the number of falling blocks."""
    return simulation.model_copy(update={"rockfall": simulation.rockfall.model_copy(update={"count": count})})


def true_difference(wall: SurfaceRaster, epoch: LaterEpoch) -> NDArray[np.float32]:
    """Return the true change of the wall in an epoch, as a difference map without the errors of a sensor.

    wall: raster of the wall before the blocks fell. epoch: holds the wall after that. Returns (h, w), m; NaN where there is no
    wall.
    """
    return difference(wall, surface_raster(epoch.carved.mesh, wall.grid))


def _cut(config: DatasetConfig, epoch: LaterEpoch, shown: _Annotated, truth: NDArray[np.float32] | None) -> Iterator[EpochTile]:
    """Cut the difference map into tiles with annotations."""
    labels = np.where(np.isnan(epoch.difference), np.int32(WALL), shown.labels)
    whole = np.bincount(labels.ravel())
    size = config.tiles.size_px
    for tile in tiles(epoch.difference, labels, epoch.raster.grid, config.tiles):
        annotations = [_described(each, shown.blocks, whole, config) for each in block_annotations(tile.block, config.annotation)]
        yield EpochTile(tile, annotations, None if truth is None else _window(truth, tile.row, tile.column, size))


def _window(raster: NDArray[np.float32], row: int, column: int, size: int) -> NDArray[np.float32]:
    """Return a square of a raster, with NaN beyond its edge."""
    window = raster[row : row + size, column : column + size]
    return np.pad(window, [(0, size - length) for length in window.shape], constant_values=np.nan)


def _described(
    annotation: dict[str, Any], blocks: Mapping[int, dict[str, Any]], whole: NDArray[np.intp], config: DatasetConfig
) -> dict[str, Any]:
    """Add what is known of its block to a COCO annotation; lengths in m, volumes in m^3."""
    block = blocks[annotation["block"]]
    ratio = block["signal_to_noise"]
    named: dict[str, Any] = {key: block[key] for key in ("category_id", "block") if key in block}
    return annotation | {
        "shape": block["shape"],
        "size_m": [round(value, 5) for value in block["size_m"]],
        "depth_m": round(block["measured_mean_depth_m"], 5),
        "volume_m3": round(block["volume_m3"], 8),
        "measured_volume_m3": round(block["measured_volume_m3"], 8),
        "signal_to_noise": ratio,
        "ignore": int(ratio is not None and ratio < config.annotation.ignore_below),
        "share_in_tile": round(annotation["area"] / int(whole[annotation["block"]]), 4),
        **named,
    }


def _record(config: DatasetConfig, epoch: PlannedEpoch, found: LaterEpoch) -> dict[str, Any]:
    """Return the epoch's description for its shard."""
    return {
        "epoch": epoch.to_dict(),
        "seed": config.seed,
        "blocks": len(found.blocks),
        "registration": None if found.registration is None else found.registration.to_dict(),
        "outside_blocks": found.statistics.outside.to_dict(),
        "inside_blocks": found.statistics.inside.to_dict(),
    }
