"""Simulate the epochs of a data set's time series, and say which of their changes are annotated.

Each series is a wall on which rock that fell stays fallen. Missing rock is annotated; moved blocks, fallen fragments, snow and
the drift of the sensor are changes that a detector must learn to tell from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.change.annotate import KIND_CATEGORIES
from pipeline.config.series import SeriesConfig
from pipeline.config.simulation import SimulationConfig
from pipeline.dataset.config import DatasetConfig
from pipeline.dataset.plan import PlannedEpoch, random_of_reference, random_of_series, random_of_wall, simulation_of
from pipeline.report.progress import Progress
from pipeline.run.epoch import LaterEpoch, ReferenceEpoch, measure_blocks
from pipeline.run.series import Series, SeriesScene, observe_series_epoch
from pipeline.run.site import SensorSite
from scene.blocks.carve import block_records
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, IntArray
from scene.series.evolution import KINDS, Loose


def reference_site(config: DatasetConfig, epoch: PlannedEpoch, site: SensorSite) -> SensorSite:
    """Return the wall and the sensor in the conditions of the reference epoch: of the first epoch if there is a time series.

    Parameters
    ----------
    config : Config of the set.
    epoch : An epoch that is compared with the reference.
    site : The untouched wall and the sensor as configured.
    """
    simulation = simulation_of(config, epoch)
    if simulation.series is None:
        return site
    return _series(config, epoch, simulation, simulation.series, site, random_of_reference(config, epoch)).site_at(0)


class SeriesWalk:
    """Follows the wall of one time series from epoch to epoch, and begins again for another series or an earlier epoch.

    The wall at an epoch is the same whether the epochs before it were simulated here, elsewhere, or not at all.
    """

    def __init__(self, config: DatasetConfig, site: SensorSite) -> None:
        """Prepare to follow time series of a wall. config: of the set. site: the untouched wall and the sensor."""
        self._config, self._site = config, site
        self._key: object = None
        self._series: Series | None = None
        self._scenes: Iterator[SeriesScene] = iter(())
        self._scene: SeriesScene | None = None

    def to(self, epoch: PlannedEpoch) -> tuple[Series, SeriesScene]:
        """Return a planned epoch's time series and its true wall. Raises InputError if a rock finds no room on the wall."""
        key = epoch.size, epoch.split, epoch.number
        series, scene = self._series, self._scene
        if series is None or self._key != key or scene is None or scene.number > epoch.step:
            simulation = simulation_of(self._config, epoch)
            if simulation.series is None:
                raise ValueError(f"{epoch.name} is not an epoch of a series")
            random = random_of_series(self._config, epoch)
            series = _series(self._config, epoch, simulation, simulation.series, self._site, random)
            self._scenes, scene = series.scenes(), None
        self._key = None  # kept only if all goes well
        while scene is None or scene.number < epoch.step:
            scene = next(self._scenes)
        self._key, self._series, self._scene = key, series, scene
        return series, scene


def observe_step(
    walk: SeriesWalk, reference: ReferenceEpoch, epoch: PlannedEpoch, progress: Progress
) -> tuple[LaterEpoch, SeriesScene]:
    """Simulate the measurement of an epoch of a time series, and compare it with the reference; return it with the true wall.

    Parameters
    ----------
    walk : Follows the wall to the epoch.
    reference : The reference epoch.
    epoch : The planned epoch.
    progress : Receives the progress.
    """
    with progress.stage(f"epoch {epoch.step}: carve"):
        series, scene = walk.to(epoch)
    return observe_series_epoch(series, reference, scene, None, progress), scene


def annotated(found: LaterEpoch, scene: SeriesScene, kinds: bool) -> tuple[IntArray, dict[int, dict[str, Any]]]:
    """Choose which changes of an epoch of a time series are annotated in the data set.

    Missing rock always is. With `kinds`, blocks that moved and fragments that were deposited are too, in categories
    of their own.

    Parameters
    ----------
    found : The simulated epoch.
    scene : Its true wall.
    kinds : Whether to annotate these other changes.

    Returns
    -------
    The label of each pixel of the difference map, (h, w) from 1, 0 where nothing is annotated; and for each label the record of
    its block. With `kinds`, a record also has its `category_id`, and under `block` the number of the rockfall that it belongs to.
    """
    state, rules = scene.state, scene.rules
    if state is None or rules is None:
        raise ValueError("a series of the user's own meshes has no labels")
    records: dict[int, dict[str, Any]] = {each["label"]: each for each in found.blocks}
    if kinds:
        laid = {each.number for each in state.deposits}
        others = [(each, "moved") for each in state.hanging]
        others += [(each, "deposit") for each in state.loose if each.rockfall.number in laid]
        ratio = np.full(len(KINDS) * len(rules.rockfalls), np.nan)
        measured = measure_blocks(found.difference, found.raster, ratio)
        for each, kind in others:
            label = rules.label(each.rockfall.number, kind)
            records[label] = _record(each) | measured[label - 1]
        ids = {each["name"]: each["id"] for each in KIND_CATEGORIES}
        for label, record in records.items():
            rockfall, kind = rules.rockfall_of(label)
            records[label] = record | {"category_id": ids[kind], "block": rockfall.number}
    shown = np.isin(found.raster.block, list(records))
    return np.where(shown, found.raster.block, np.int32(WALL)), records


def _record(rock: Loose) -> dict[str, Any]:
    """Return the record of a rock that has moved or fallen."""
    return block_records(rock.block, np.array([rock.volume_m3]))[0]


def _series(
    config: DatasetConfig,
    epoch: PlannedEpoch,
    simulation: SimulationConfig,
    series: SeriesConfig,
    site: SensorSite,
    random: KeyedRandom,
) -> Series:
    """Return a time series, in which plants grow in the same places of the wall as in all others of the set."""
    return replace(Series.of(simulation, series, site, random), plants=random_of_wall(config, epoch.wall))
