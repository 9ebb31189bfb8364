"""What a worker does: make an epoch of the set and store its tiles and shard in the folder, which all workers share."""

from __future__ import annotations

import os
import resource
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipeline.dataset.config import DatasetConfig
from pipeline.dataset.epoch import EpochTile, MadeEpoch, StageCache, make_epoch
from pipeline.dataset.folder import STAGING, TRUTH
from pipeline.dataset.plan import PlannedEpoch, planned_epochs
from pipeline.dataset.records import SCHEMA, SHARDS, read_dataset_file, shard_name, write_shard
from pipeline.formats.files.atomic import explained, give_name, to_disk
from pipeline.formats.files.checksum import sha256
from pipeline.formats.files.inside import inside
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.report.progress import Progress
from pipeline.report.provenance import versions
from scene.common.backend import VARIANT, dr
from scene.common.config import parse
from scene.common.errors import InputError

_one_at_a_time = threading.Lock()
"""Dask may give a worker several threads, but one stage serves one run of epochs at a time."""


@dataclass(frozen=True)
class EpochOrder:
    """The instruction to a worker to make one epoch of a data set.

    Attributes
    ----------
    folder : Folder of the set.
    job : Identifier of the job, which names its staging folder.
    source : Fingerprint (a hash) of the data set's config.
    index : Index of the epoch in the plan of that config.
    stage : Key of its set-up (`PlannedEpoch.stage`).
    threads : Threads to use; 0: all.
    """

    folder: str
    job: str
    source: str
    index: int
    stage: tuple[str, str, str, int]
    threads: int = 0


@dataclass(frozen=True)
class _SourcePlan:
    """What a worker keeps of a source between epochs: config, plan, set-up and prefix of file names."""

    config: DatasetConfig
    plan: list[PlannedEpoch]
    stages: StageCache
    prefix: str


@lru_cache(maxsize=1)
def _source_plan(folder: str, job: str, source: str) -> _SourcePlan:
    """Read the config of a source from the folder; a new `job` reads it again."""
    entry = read_dataset_file(Path(folder))["sources"][source]
    require_same_versions(entry, folder)
    config = parse(DatasetConfig, entry["config"], folder)
    return _SourcePlan(config, planned_epochs(config), StageCache(config), entry["prefix"])


def package_versions() -> dict[str, str]:
    """Return the versions on which the bytes of a data set depend besides its config.

    They are of packages and of the ray tracer's backend, by name.
    """
    return {**versions(), "backend": VARIANT}


def require_same_versions(entry: dict[str, Any], where: str) -> None:
    """Raise InputError if package versions here differ from those with which a data set was started.

    Other versions could change the bytes of its epochs. entry: what dataset.json stores of the config that makes them, with the
    versions. where: name of the file or folder, for errors.
    """
    before, here = entry["versions"], package_versions()
    differ = sorted(key for key in before if key != "platform" and here.get(key) != before[key])
    if differ:
        packages_before_and_here = ", ".join(f"{key} {before[key]} (here {here.get(key, 'none')})" for key in differ)
        raise InputError(
            f"the set was started with other versions of packages: {packages_before_and_here}",
            where=where,
            remedy="install the earlier versions again, or make the set in another folder",
        )


def use_threads(count: int) -> None:
    """Limit the threads of the ray tracer and of the image library in this process; 0: no limit."""
    if count:
        import cv2

        dr.set_thread_count(count)
        cv2.setNumThreads(count)


def make_and_store_run(orders: Sequence[EpochOrder]) -> list[dict[str, Any]]:
    """Make epochs of a data set that share wall and reference one after the other, so that these are loaded once.

    Parameters
    ----------
    orders : Which epochs to make, and in which folder.

    Returns
    -------
    The times, memory and tiles of each epoch, as `make_and_store` returns them.
    """
    with _one_at_a_time:
        return [make_and_store(order) for order in orders]


def make_and_store(order: EpochOrder) -> dict[str, Any]:
    """Simulate an epoch of a data set and store its tiles and its record.

    Parameters
    ----------
    order : Which epoch to make, and in which folder.

    Returns
    -------
    Wall time of each step and processor time, s, the worker's peak memory so far, GB, and the number of tiles.
    """
    began = time.process_time()
    use_threads(order.threads)
    workshop = _source_plan(order.folder, order.job, order.source)
    epoch, progress = workshop.plan[order.index], Progress()
    made = make_epoch(workshop.config, epoch, workshop.stages, progress)
    with progress.stage("write"):
        _store(Path(order.folder), order, workshop.prefix, epoch, made)
    tiles = len(made.tiles)
    del made
    dr.flush_malloc_cache()  # free the ray tracer's memory before carving, which needs most on large walls
    return {
        "index": order.index,
        "tiles": tiles,
        "seconds": {_stage_name(name): value for name, value in progress.timings.items()},
        "cpu_seconds": time.process_time() - began,
        "peak_memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "process": os.getpid(),
    }


def _stage_name(name: str) -> str:
    """Return a step's name without the epoch's number; steps of the reference epoch count as set-up."""
    if name.startswith("epoch 0: ") or name == "wall":
        return f"set up: {name.removeprefix('epoch 0: ')}"
    return name.partition(": ")[2] or name


def _store(folder: Path, order: EpochOrder, prefix: str, epoch: PlannedEpoch, made: MadeEpoch) -> None:
    """Write tiles and shard under temporary names, then rename them, the shard last."""
    staging = folder / STAGING / order.job / f"{order.source}_{order.index:06d}"
    entries = [_write_tile(staging, prefix, epoch, tile) for tile in made.tiles]
    for name in (name for entry in entries for name in _names(entry)):
        final = inside(folder, f"{epoch.split}/{name}", folder)
        with explained(final):
            final.parent.mkdir(parents=True, exist_ok=True)
            (staging / name).replace(final)
    for each in {(folder / epoch.split / name).parent for entry in entries for name in _names(entry)}:
        to_disk(each)
    record = {"schema": SCHEMA, "source": order.source, **made.record, "tiles": entries}
    name = shard_name(order.source, order.index)
    write_shard(staging, name, record)
    final = inside(folder, f"{SHARDS}/{name}", folder)
    with explained(final):
        final.parent.mkdir(exist_ok=True)
        give_name(staging / SHARDS / name, final)


def _names(entry: dict[str, Any]) -> Iterator[str]:
    """Yield the file names of a tile."""
    yield entry["image"]["file_name"]
    if entry["truth_sha256"] is not None:
        yield entry["image"]["truth_file_name"]


def _write_tile(staging: Path, prefix: str, epoch: PlannedEpoch, made: EpochTile) -> dict[str, Any]:
    """Write a tile, and its truth, into the staging folder; return its entry in the shard."""
    tile = made.tile
    name = f"{prefix}{epoch.name}_{tile.name}.tif"
    write_geotiff(staging / name, tile.values, tile.grid, description="reference minus epoch, m", with_mask=True)
    image = {
        "file_name": name,
        "width": tile.grid.width,
        "height": tile.grid.height,
        "row": tile.row,
        "column": tile.column,
        "x_min_m": tile.grid.x_min,
        "y_max_m": tile.grid.y_max,
        "gsd_m": tile.grid.gsd,
        "valid_share": round(tile.valid_share, 6),
    }
    truth_digest = None
    if made.truth is not None:
        image["truth_file_name"] = f"{TRUTH}/{name}"
        write_geotiff(staging / TRUTH / name, made.truth, tile.grid, description="true difference, m", with_mask=True)
        truth_digest = sha256(staging / TRUTH / name)
    digest = sha256(staging / name)
    return {"image": image, "sha256": digest, "truth_sha256": truth_digest, "annotations": made.annotations}
