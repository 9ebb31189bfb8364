"""Make a whole data set, or what is missing of it: find the missing epochs, make them, and assemble the set.

Epochs are made in this process, or with Dask's distributed on local processes or on the user's scheduler. Dask handles queues,
lost workers and retries: if a worker dies, another one makes its epoch, with the same bytes.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.dataset.assemble import assemble, assembled_damage
from pipeline.dataset.config import DATASET_FILE, DatasetConfig
from pipeline.dataset.folder import (
    Damage,
    discard_unbegun,
    epoch_damage,
    fingerprint,
    remove_leftovers,
    require_no_folders,
    require_own_folders,
)
from pipeline.dataset.plan import planned_epochs
from pipeline.dataset.records import read_dataset_file, shard_name, write_dataset_file
from pipeline.dataset.worker import EpochOrder, make_and_store, package_versions, require_same_versions
from pipeline.formats.files.lock import is_free, locked
from pipeline.report.progress import Progress
from scene.common.config import parse
from scene.common.errors import InputError, OutsideError

_MOST_WORKERS = 16
"""Largest number of local processes for each core."""


@dataclass(frozen=True)
class Workers:
    """Who makes the epochs of a data set: local processes, a Dask scheduler's workers, or (if neither is given) this process.

    count: number of local processes. scheduler: address of the scheduler, or empty.
    """

    count: int = 0
    scheduler: str = ""

    def check(self) -> None:
        """Raise InputError if there are more local processes than the machine can start."""
        cores = len(os.sched_getaffinity(0))
        if self.count > _MOST_WORKERS * cores:
            raise InputError(
                f"the number of workers is {self.count:,}",
                where="--workers",
                allowed=f"1 to {_MOST_WORKERS * cores} here, {_MOST_WORKERS} for each of {cores} cores",
                remedy="choose a number in this range",
            )


@dataclass
class DatasetSummary:
    """Result of making, verifying or combining a data set.

    Attributes
    ----------
    folder : Folder of the set.
    made : Times, memory and number of tiles of each epoch that was made now (see `worker.make_and_store`).
    images, annotations : Numbers in the whole set, by split (train, val, test).
    damage : Files that were missing or damaged when the set was checked.
    warnings : Warnings about the set.
    """

    folder: Path
    made: list[dict[str, Any]] = field(default_factory=list)
    images: dict[str, int] = field(default_factory=dict)
    annotations: dict[str, int] = field(default_factory=dict)
    damage: list[Damage] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def summary(self) -> str:
        """Return the result of making or verifying the data set as lines of text."""
        splits = ", ".join(f"{name} {self.images[name]:,} tiles with {self.annotations[name]:,} blocks" for name in self.images)
        warnings = "".join(f"\nwarning: {each}" for each in self.warnings)
        return f"{len(self.made)} epochs made; {splits}\ncard: {self.folder / 'README.md'}{warnings}"


def make_dataset(
    config: DatasetConfig, out: Path, workers: Workers = Workers(), *, command: str = "", progress: Progress | None = None
) -> DatasetSummary:
    """Make a data set, or complete one that was interrupted.

    On an interrupt, annotations and README of the finished epochs are written before KeyboardInterrupt is raised.

    Parameters
    ----------
    config : Config of the set.
    out : Folder that is new, empty, or holds a set of the same config.
    workers : Who makes the epochs.
    command : The command, which the set's README states.
    progress : Receives the progress; None: nothing is shown.

    Raises
    ------
    InputError
        If the folder is in use or holds another set, or an epoch cannot be made.
    OutsideError
        If workers die.
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
    """Read every byte of a set, and make again what is missing or damaged.

    Parameters
    ----------
    folder : Folder of the set.
    workers : Who makes the epochs.
    repair : False only reports the damage.
    progress : Receives the progress; None: nothing is shown.
    """
    progress = progress or Progress()
    workers.check()
    read_dataset_file(folder)
    with locked(folder):
        if repair:
            return _complete(folder, workers, progress)
        found = _find_damage(folder, progress)
        damage = [each for problems in found.values() for each in problems]
        return DatasetSummary(folder, damage=damage + assembled_damage(folder))


def _claim(out: Path, config: DatasetConfig, command: str) -> None:
    """Check that `out` is new, empty, or holds a set of the same config and versions; in a new one, write dataset.json."""
    source = fingerprint(config)
    if (out / DATASET_FILE).exists():
        known = read_dataset_file(out)
        if list(known["sources"]) != [source]:
            raise InputError(
                f"the folder holds the set {known['name']} ({', '.join(known['sources'])}), "
                f"but the given config makes the set {source}",
                where=str(out),
                remedy="use the config that the set was started with, or choose another --out",
            )
        require_same_versions(known["sources"][source], str(out))
        return
    if not is_free(out):
        raise InputError("the folder exists and is not empty", where=f"--out {out}", remedy="choose another --out")
    entry = {"config": config.model_dump(mode="json"), "versions": package_versions(), "command": command, "prefix": ""}
    write_dataset_file(out, config.name, {source: entry}, {source: [epoch.index for epoch in planned_epochs(config)]})


def _find_damage(folder: Path, progress: Progress) -> dict[tuple[str, int], list[Damage]]:
    """Return the damage of each epoch that is missing or damaged."""
    epochs = [(source, index) for source, indices in read_dataset_file(folder)["epochs"].items() for index in indices]
    found = {}
    with progress.stage("check") as stage:
        for done, (source, index) in enumerate(epochs):
            damage = epoch_damage(folder, shard_name(source, index))
            if damage:
                found[source, index] = damage
            stage.advance(done / len(epochs))
    return found


def _complete(folder: Path, workers: Workers, progress: Progress) -> DatasetSummary:
    """Complete the set, and remove all temporary files whatever happens."""
    require_own_folders(folder)
    remove_leftovers(folder)
    try:
        return _completed(folder, workers, progress)
    finally:
        remove_leftovers(folder)


def _completed(folder: Path, workers: Workers, progress: Progress) -> DatasetSummary:
    """Make missing and damaged epochs, and assemble the set."""
    progress.plan({"check": 1.0, "epochs": 1000.0, "card": 10.0})
    known = read_dataset_file(folder)
    found = _find_damage(folder, progress)
    damage = [each for problems in found.values() for each in problems if known["complete"] or not each.is_missing_shard]
    summary = DatasetSummary(folder, damage=damage + (assembled_damage(folder) if known["complete"] else []))
    require_no_folders(folder, [*summary.damage, *(each for problems in found.values() for each in problems)])
    stages = {source: _stages(known, source, folder) for source in {source for source, _ in found}}
    unplanned = [index for source, index in found if index >= len(stages[source])]
    if unplanned:
        raise InputError(
            f"epoch {unplanned[0]} is not in the plan of its config",
            where=str(folder / DATASET_FILE),
            remedy="restore dataset.json from a copy, or make the set again in another folder",
        )
    write_dataset_file(folder, known["name"], known["sources"], known["epochs"])
    job = uuid.uuid4().hex
    orders = [EpochOrder(str(folder.absolute()), job, source, index, stages[source][index]) for source, index in found]
    try:
        with progress.stage("epochs") as stage:
            for taken in _make_all(orders, workers):
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
    """Return the stage of every epoch of a source; raise InputError if they cannot be made with the same bytes here."""
    entry, where = known["sources"][source], str(folder / DATASET_FILE)
    require_same_versions(entry, where)
    config = parse(DatasetConfig, entry["config"], where)
    if fingerprint(config) != source:
        raise InputError(
            f"the config of the set {source} was changed after its epochs were made",
            where=where,
            remedy="restore dataset.json and the files that it names from a copy, or make the set again in another folder",
        )
    return [epoch.stage for epoch in planned_epochs(config)]


def _make_all(orders: list[EpochOrder], workers: Workers) -> Iterator[dict[str, Any]]:
    """Make epochs and yield what each took, in the order in which they finish."""
    if not orders:
        return
    if not (workers.count or workers.scheduler):
        yield from map(make_and_store, orders)
        return
    from pipeline.dataset.cluster import make_on_cluster  # Dask is slow to import and optional

    yield from make_on_cluster(orders, workers.count, workers.scheduler)
