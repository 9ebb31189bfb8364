"""Merge finished sets into one, and split one into several: tiles and shards are copied, the other files are assembled again."""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pipeline.dataset.assemble import assemble, complete_shards, has_kinds
from pipeline.dataset.folder import tile_files
from pipeline.dataset.records import SHARDS, Record, read_dataset_file, shard_name, write_dataset_file, write_shard
from pipeline.dataset.run import DatasetSummary
from pipeline.formats.files.atomic import note, noting, remove_written
from pipeline.formats.files.checksum import sha256
from pipeline.formats.files.inside import inside
from pipeline.formats.files.lock import is_free, locked
from scene.common.errors import InputError, nearest

KEYS = ("sensor", "noise", "size", "wall", "split")
"""Properties of an epoch by which a set can be split."""


def merge_datasets(folders: Sequence[Path], out: Path) -> DatasetSummary:
    """Merge finished data sets into a new one and return its summary.

    Ids are assigned again, and each file name gets the fingerprint (a hash of the config) of its set as a prefix.

    Parameters
    ----------
    folders : Two or more finished sets.
    out : New folder.

    Raises
    ------
    InputError
        If a set is unfinished, two sets hold the same epochs, only some have categories for the kind of change, or the folder
        is in use.
    """
    if len(folders) < 2:
        raise InputError(
            f"two or more folders are needed, got {len(folders)}",
            where="scarpsim dataset merge",
            remedy="name the folders of the sets to merge",
        )
    sets = [(folder, _finished(folder)) for folder in folders]
    _check_categories(sets)
    sources: dict[str, Any] = {}
    epochs: dict[str, list[int]] = defaultdict(list)
    for folder, dataset in sets:
        for source, indices in dataset["epochs"].items():
            if set(epochs[source]) & set(indices):
                raise InputError("another of the given sets has the same epochs", where=str(folder), remedy="give each set once")
            epochs[source] = sorted({*epochs[source], *indices})
            sources[source] = {**dataset["sources"][source], "prefix": f"{source}_"}
    with locked(_new(out)), _all_or_nothing(out):
        for folder, dataset in sets:
            for record in complete_shards(folder, dataset):
                _copy(folder, out, record, dataset["sources"][record["source"]]["prefix"], f"{record['source']}_")
        name = "-".join(dict.fromkeys(dataset["name"] for _, dataset in sets))
        return _finish(out, name, sources, dict(epochs))


def _check_categories(sets: Sequence[tuple[Path, Record]]) -> None:
    """Raise InputError if only some of the sets annotate moved and deposited rock: one label would mean two things."""
    with_kinds, without = ([folder for folder, dataset in sets if has_kinds(dataset) is wanted] for wanted in (True, False))
    if with_kinds and without:
        raise InputError(
            f"{with_kinds[0]} has categories for missing, moved and deposited rock, and {without[0]} has one category, block",
            where="scarpsim dataset merge",
            remedy="merge sets that were made with the same `series.kinds`",
        )


def split_dataset(folder: Path, out: Path, keys: Sequence[str]) -> list[DatasetSummary]:
    """Split a finished data set into new ones by properties of its tiles, such as one for each sensor and noise level.

    Parameters
    ----------
    folder : The finished set.
    out : Folder of the new sets, which are named after the values of their properties.
    keys : Properties: sensor, noise, size, wall, split.

    Returns
    -------
    A summary of each new set.

    Raises
    ------
    InputError
        If a key is unknown or the folder is in use.
    """
    for key in keys:
        if key not in KEYS:
            raise InputError(
                f"unknown key '{key}'",
                where="--by",
                allowed=", ".join(KEYS),
                remedy=nearest(key, KEYS) or "choose one of these keys",
            )
    dataset = _finished(folder)
    found: dict[str, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for record in complete_shards(folder, dataset):
        name = "_".join(record["epoch"][key] for key in keys)
        found[name][record["source"]].append(record["epoch"]["index"])
    with _all_or_nothing(out):
        return [_part(folder, out / name, f"{dataset['name']}_{name}", dataset, epochs) for name, epochs in found.items()]


@contextmanager
def _all_or_nothing(out: Path) -> Iterator[None]:
    """Remove what the block wrote into `out` if it ends with an InputError."""
    missing = [each for each in (out, *out.parents) if not each.exists()]
    with noting() as written:
        try:
            yield
        except InputError:
            remove_written(out, written)
            for each in missing:
                with suppress(OSError):  # contains files of others
                    each.rmdir()
            raise


def _part(folder: Path, out: Path, name: str, dataset: Record, epochs: dict[str, list[int]]) -> DatasetSummary:
    """Copy some epochs of a set into a new one."""
    sources = {source: dataset["sources"][source] for source in epochs}
    with locked(_new(out)):
        for record in complete_shards(folder, {"epochs": epochs}):
            prefix = sources[record["source"]]["prefix"]
            _copy(folder, out, record, prefix, prefix)
        return _finish(out, name, sources, {source: list(indices) for source, indices in epochs.items()})


def _finished(folder: Path) -> Record:
    """Read dataset.json, and raise InputError if the set is not finished."""
    dataset = read_dataset_file(folder)
    if not dataset["complete"]:
        raise InputError(
            "the set is not finished",
            where=str(folder),
            remedy="run the scarpsim dataset command that makes this set once more; it continues where it stopped",
        )
    return dataset


def _new(out: Path) -> Path:
    """Return the folder, or raise InputError if it is in use."""
    if out.exists() and not is_free(out):
        raise InputError("the path exists and is not an empty folder", where=f"--out {out}", remedy="choose another --out")
    return out


def _copy(folder: Path, out: Path, record: Record, before: str, after: str) -> None:
    """Copy an epoch's tiles and shard, replacing the prefix of the tiles' names."""
    old = [name for name, _ in tile_files(record)]
    for tile in record["tiles"]:
        image = tile["image"]
        image["file_name"] = after + image["file_name"].removeprefix(before)
        if "truth_file_name" in image:
            parent, _, name = image["truth_file_name"].rpartition("/")
            image["truth_file_name"] = f"{parent}/{after}{name.removeprefix(before)}"
    shard = shard_name(record["source"], record["epoch"]["index"])
    for name, (new, digest) in zip(old, tile_files(record), strict=True):
        source, target = inside(folder, name, folder / SHARDS / shard), inside(out, new, folder / SHARDS / shard)
        target.parent.mkdir(parents=True, exist_ok=True)
        note(target)
        if not source.is_file() or sha256(shutil.copyfile(source, target)) != digest:
            raise InputError(
                "the file is missing or damaged",
                where=str(source),
                remedy="run scarpsim dataset verify on the folder of the data set, which lists all damaged files",
            )
    write_shard(out, shard, record)


def _finish(out: Path, name: str, sources: dict[str, Any], epochs: dict[str, list[int]]) -> DatasetSummary:
    """Assemble a merged or split set."""
    write_dataset_file(out, name, sources, epochs)
    assembled = assemble(out, complete=True)
    write_dataset_file(out, name, sources, epochs, complete=True)
    return DatasetSummary(out, images=assembled.images, annotations=assembled.annotations, warnings=assembled.warnings)
