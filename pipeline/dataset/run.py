"""A whole data set: which epochs are missing, who makes them, and what is put together when they are there.

In this process by default; with Dask's distributed on a cluster of local processes or on a scheduler of the user's. Queues, lost
workers and retries are Dask's business: an epoch that a dead worker left is made by another one, to the same bytes.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.dataset.assemble import assemble, assembled_damages
from pipeline.dataset.config import DATASET_FILE, DatasetConfig
from pipeline.dataset.folder import (
    Damage,
    damages,
    discard_unbegun,
    fingerprint,
    remove_leftovers,
    require_no_folders,
    require_own_folders,
)
from pipeline.dataset.plan import planned_epochs
from pipeline.dataset.records import read_dataset_file, shard_name, write_dataset_file
from pipeline.dataset.worker import Order, fill, makers, require_same_makers
from pipeline.formats.files.lock import is_free, locked
from pipeline.report.progress import Progress
from scene.common.config import parse
from scene.common.errors import InputError, OutsideError

_MOST_WORKERS = 16
"""Local processes for each core."""


@dataclass(frozen=True)
class Workers:
    """Who makes the epochs. count: local processes; scheduler: address of a Dask scheduler; neither: this process."""

    count: int = 0
    scheduler: str = ""

    def check(self) -> None:
        """Raise InputError for more local processes than the machine can start."""
        cores = len(os.sched_getaffinity(0))
        if self.count > _MOST_WORKERS * cores:
            allowed = f"1 to {_MOST_WORKERS * cores} here, {_MOST_WORKERS} for each of {cores} cores"
            raise InputError(f"got {self.count:,}", where="--workers", allowed=allowed)


@dataclass
class DatasetSummary:
    """What a job did. folder: of the set; made: what each epoch took that it made (`worker.fill`); images, annotations: of the
    whole set, by split; damage: what was wrong with epochs that were there before; warnings: what is amiss with the set."""

    folder: Path
    made: list[dict[str, Any]] = field(default_factory=list)
    images: dict[str, int] = field(default_factory=dict)
    annotations: dict[str, int] = field(default_factory=dict)
    damage: list[Damage] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def summary(self) -> str:
        splits = ", ".join(f"{name} {self.images[name]:,} tiles with {self.annotations[name]:,} blocks" for name in self.images)
        warnings = "".join(f"\nwarning: {each}" for each in self.warnings)
        return f"{len(self.made)} epochs made; {splits}\ncard: {self.folder / 'README.md'}{warnings}"


def make_dataset(
    config: DatasetConfig, out: Path, workers: Workers = Workers(), *, command: str = "", progress: Progress | None = None
) -> DatasetSummary:
    """Make a data set, or what is missing of it: the same call goes on with one that was interrupted, however it was.

    out: a folder that is new, empty, or holds a set of the same config. command: for the card. Raises InputError for a
    folder in use or of another set. On an interrupt what is finished is put together before KeyboardInterrupt goes on.
    """
    progress = progress or Progress()
    workers.check()
    with locked(out):
        _claim(out, config, command)
        try:
            return _complete(out, workers, progress)
        except (InputError, OutsideError):
            discard_unbegun(out)
            raise


def verify_dataset(
    folder: Path, workers: Workers = Workers(), *, repair: bool = True, progress: Progress | None = None
) -> DatasetSummary:
    """Read every byte of a set, and make again what is missing or damaged; with repair=False only report it."""
    progress = progress or Progress()
    workers.check()
    read_dataset_file(folder)
    with locked(folder):
        if repair:
            return _complete(folder, workers, progress)
        found = _find_damage(folder, progress)
        damage = [each for problems in found.values() for each in problems]
        return DatasetSummary(folder, damage=damage + assembled_damages(folder))


def _claim(out: Path, config: DatasetConfig, command: str) -> None:
    """Make sure that `out` is ours to write to: new, empty, or a set of the same config and versions."""
    source = fingerprint(config)
    if (out / DATASET_FILE).exists():
        known = read_dataset_file(out)
        if list(known["sources"]) != [source]:
            raise InputError(
                f"holds the set {known['name']} ({', '.join(known['sources'])}), the config is of another ({source})",
                where=str(out),
                remedy="go on with the config it was begun with, or choose another --out",
            )
        require_same_makers(known["sources"][source], str(out))
        return
    if not is_free(out):
        raise InputError("the folder exists and is not empty", where=f"--out {out}", remedy="choose another --out")
    entry = {"config": config.model_dump(mode="json"), "versions": makers(), "command": command, "prefix": ""}
    write_dataset_file(out, config.name, {source: entry}, {source: [epoch.index for epoch in planned_epochs(config)]})


def _find_damage(folder: Path, progress: Progress) -> dict[tuple[str, int], list[Damage]]:
    """What is wrong with each epoch of the set that is not whole."""
    epochs = [(source, index) for source, indices in read_dataset_file(folder)["epochs"].items() for index in indices]
    found = {}
    with progress.stage("check") as stage:
        for done, (source, index) in enumerate(epochs):
            damage = damages(folder, shard_name(source, index))
            if damage:
                found[source, index] = damage
            stage.advance(done / len(epochs))
    return found


def _complete(folder: Path, workers: Workers, progress: Progress) -> DatasetSummary:
    """Make what is missing or damaged, and put the set together; whatever happens, nothing stays under temporary names."""
    require_own_folders(folder)
    remove_leftovers(folder)
    try:
        return _completed(folder, workers, progress)
    finally:
        remove_leftovers(folder)


def _completed(folder: Path, workers: Workers, progress: Progress) -> DatasetSummary:
    progress.plan({"check": 1.0, "epochs": 1000.0, "card": 10.0})
    known = read_dataset_file(folder)
    found = _find_damage(folder, progress)
    damage = [each for problems in found.values() for each in problems if known["complete"] or not each.is_missing_shard]
    summary = DatasetSummary(folder, damage=damage + (assembled_damages(folder) if known["complete"] else []))
    require_no_folders(folder, [*summary.damage, *(each for problems in found.values() for each in problems)])
    stages = {source: _stages(known, source, folder) for source in {source for source, _ in found}}
    unplanned = [index for source, index in found if index >= len(stages[source])]
    if unplanned:
        raise InputError(f"holds epoch {unplanned[0]}, which its config does not plan", where=str(folder / DATASET_FILE))
    write_dataset_file(folder, known["name"], known["sources"], known["epochs"])
    job = uuid.uuid4().hex
    orders = [Order(str(folder.absolute()), job, source, index, stages[source][index]) for source, index in found]
    try:
        with progress.stage("epochs") as stage:
            for taken in _fill_all(orders, workers):
                summary.made.append(taken)
                stage.advance(len(summary.made) / len(orders))
    except KeyboardInterrupt:
        assemble(folder, complete=False)
        raise
    with progress.stage("card"):
        assembled = assemble(folder, complete=True)
        write_dataset_file(folder, known["name"], known["sources"], known["epochs"], complete=True)
    summary.images, summary.annotations, summary.warnings = assembled.images, assembled.annotations, assembled.warnings
    return summary


def _stages(known: dict[str, Any], source: str, folder: Path) -> list[tuple[str, str, str, int]]:
    """The stage of every epoch of a source; raises InputError where it cannot be made here as it was."""
    entry, where = known["sources"][source], str(folder / DATASET_FILE)
    require_same_makers(entry, where)
    config = parse(DatasetConfig, entry["config"], where)
    if fingerprint(config) != source:
        remedy = "put dataset.json, and the files that it names, back as they were"
        raise InputError(f"the config of {source} is not the one that its epochs were made with", where=where, remedy=remedy)
    return [epoch.stage for epoch in planned_epochs(config)]


def _fill_all(orders: list[Order], workers: Workers) -> Iterator[dict[str, Any]]:
    """What each order took, in the order in which they are done."""
    if not orders:
        return
    if not (workers.count or workers.scheduler):
        yield from map(fill, orders)
        return
    from pipeline.dataset.cluster import fill_on_cluster  # Dask is slow to import, and an extra

    yield from fill_on_cluster(orders, workers.count, workers.scheduler)
