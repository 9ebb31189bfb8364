"""Assemble a data set from its shards, the records of single epochs.

Written are annotations.json of each split, the data set card and the checksums. The shards are read one at a time. The result
depends on the shards and dataset.json only, so that an interrupted job ends with the same bytes as an undisturbed one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from pipeline.change.annotate import BLOCK_CATEGORY, KIND_CATEGORIES
from pipeline.dataset.card import README, write_card
from pipeline.dataset.folder import CHECKSUMS, Damage, file_damage, tile_files
from pipeline.dataset.plan import SPLITS, Split
from pipeline.dataset.records import SHARDS, Record, read_dataset_file, read_shard, shard_name
from pipeline.dataset.statistics import SetStatistics
from pipeline.formats.files.atomic import write_text, writing
from pipeline.formats.files.checksum import sha256
from scene.common.errors import InputError

ANNOTATIONS = "annotations.json"


@dataclass
class AssembledSet:
    """What `assemble` found in a data set: number of images and annotations by split (train, val, test), and warnings."""

    images: dict[str, int] = field(default_factory=dict)
    annotations: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def assemble(folder: Path, *, complete: bool) -> AssembledSet:
    """Finish a data set on disk: write annotations.json of each split, the README with its figures, and the checksums.

    Image and annotation ids count from 1 through train, val and test, so that they are unique in the set.

    Parameters
    ----------
    folder : Folder of the set.
    complete : Whether all epochs have been made; False assembles those of an interrupted job.
    """
    dataset = read_dataset_file(folder)
    statistics = SetStatistics()
    digests: dict[str, str] = {}
    writer = _LastIds()
    result = AssembledSet()
    for split in SPLITS:
        records = (record for record in shards(folder, dataset) if record["epoch"]["split"] == split)
        first = next(records, None)
        if first is None:
            continue
        path = folder / split / ANNOTATIONS
        before = (writer.image, writer.annotation)
        with writing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
            found = _chained(first, records)
            _write_coco(file, _info(dataset, split, complete), _categories(dataset), found, writer, statistics, digests)
        result.images[split], result.annotations[split] = writer.image - before[0], writer.annotation - before[1]
        digests[f"{split}/{ANNOTATIONS}"] = sha256(path)
    for name in write_card(folder, dataset, statistics, digests, complete=complete):
        digests[name] = sha256(folder / name)
    for record_name in _shard_names(dataset):
        if (folder / SHARDS / record_name).exists():
            digests[f"{SHARDS}/{record_name}"] = sha256(folder / SHARDS / record_name)
    write_text(folder / CHECKSUMS, "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items())))
    result.warnings = statistics.warnings()
    return result


def shards(folder: Path, dataset: Record) -> Iterator[Record]:
    """Yield the records of the epochs that have been made (each a JSON file in the folder), in the planned order.

    folder: the data set's. dataset: content of its dataset.json.
    """
    for name in _shard_names(dataset):
        record = read_shard(folder, name)
        if record is not None:
            yield record


def complete_shards(folder: Path, dataset: Record) -> Iterator[Record]:
    """Yield the records of all epochs of a data set, in the planned order; raise InputError if one is missing or damaged.

    folder: the data set's. dataset: content of its dataset.json.
    """
    for name in _shard_names(dataset):
        record = read_shard(folder, name)
        if record is None:
            raise InputError(
                "the file is missing or damaged",
                where=str(folder / SHARDS / name),
                remedy="run scarpsim dataset verify on the folder of the data set, which lists all damaged files",
            )
        yield record


def assembled_damage(folder: Path) -> list[Damage]:
    """Return which of a data set's files on all epochs (annotations, README, checksums) are missing or damaged."""
    path = folder / CHECKSUMS
    if not path.is_file():
        return [Damage(Path(CHECKSUMS), "a folder" if path.is_dir() else "missing")]
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    listed = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    known = _known_digests(folder)
    if any(listed.get(name, "") != (digest or listed.get(name)) for name, digest in known.items()):
        return [Damage(Path(CHECKSUMS), "damaged")]
    others = [
        name for name in listed if not name.startswith(f"{SHARDS}/") and not name.endswith(".tif")
    ]  # shards hold the checksums of tiles
    return [each for name in others for each in file_damage(folder, name, listed[name], CHECKSUMS)]


def _known_digests(folder: Path) -> dict[str, str]:
    """Return the names that the list of checksums must hold, with the checksums known from the shards ("": unknown)."""
    dataset = read_dataset_file(folder)
    found: dict[str, str] = {README: ""}
    for record in shards(folder, dataset):
        shard = f"{SHARDS}/{shard_name(record['source'], record['epoch']['index'])}"
        found |= {**dict(tile_files(record)), shard: sha256(folder / shard), f"{record['epoch']['split']}/{ANNOTATIONS}": ""}
    return found


@dataclass
class _LastIds:
    """The last image and annotation ids given."""

    image: int = 0
    annotation: int = 0


def _shard_names(dataset: Record) -> Iterator[str]:
    """Yield the names of all planned shards."""
    for source, indices in dataset["epochs"].items():
        yield from (shard_name(source, index) for index in indices)


def _chained(first: Record, rest: Iterator[Record]) -> Iterator[Record]:
    """Yield the first record, then the rest."""
    yield first
    yield from rest


def _info(dataset: Record, split: Split, complete: bool) -> dict[str, Any]:
    """Return COCO's `info` section."""
    return {
        "description": f"Rockfall blocks in difference maps: {dataset['name']}, {split}",
        "version": dataset["fingerprint"],
        "contributor": "scarpsim",
        "unit": "m, reference minus epoch; missing rock is positive; NaN is no data",
        "complete": complete,
    }


def has_kinds(dataset: Record) -> bool:
    """Tell whether a data set annotates missing, moved and deposited rock in separate categories, not missing rock alone.

    dataset: content of its dataset.json. It does so if the time series of a wall sets `kinds`.
    """
    walls = (wall for source in dataset["sources"].values() for wall in source["config"]["walls"].values())
    return any((wall.get("series") or {}).get("kinds") for wall in walls)


def _categories(dataset: Record) -> list[dict[str, Any]]:
    """Return COCO's categories: of missing, moved and deposited rock if a time series distinguishes them, else the only one."""
    return KIND_CATEGORIES if has_kinds(dataset) else [BLOCK_CATEGORY]


def _write_coco(
    file: TextIO,
    info: dict[str, Any],
    categories: list[dict[str, Any]],
    records: Iterator[Record],
    ids: _LastIds,
    statistics: SetStatistics,
    digests: dict[str, str],
) -> None:
    """Stream the annotations.json of a split: annotations as they come, then the images.

    Statistics and checksums are collected on the way.

    Parameters
    ----------
    file : text file
        Where to write.
    info : dict
        Entry `info` of the file.
    categories : list of dict
        Categories of the annotations.
    records : iterator of Record
        Records of the tiles.
    ids : _LastIds
        Last ids of images and annotations; continued.
    statistics : SetStatistics
        Statistics of the whole set; added to.
    digests : dict
        Checksum of each file by name; added to.
    """
    head = {"info": info, "licenses": [], "categories": categories}
    file.write(_compact(head)[:-1] + ',"annotations":[')
    images = []
    separator = "\n"
    for record in records:
        statistics.add(record)
        digests.update(tile_files(record))
        for tile in record["tiles"]:
            ids.image += 1
            images.append(_compact(_image(record, tile, ids.image)))
            for annotation in tile["annotations"]:
                ids.annotation += 1
                entry = {"id": ids.annotation, "image_id": ids.image, **annotation, **_cell(record)}
                file.write(separator + _compact(entry))
                separator = ",\n"
    file.write('],"images":[\n' + ",\n".join(images) + "]}\n")


def _image(record: Record, tile: Record, number: int) -> dict[str, Any]:
    """Return COCO's entry of a tile."""
    return {
        "id": number,
        **tile["image"],
        **_cell(record),
        "reference": record["epoch"]["reference"],
        "noise_sigma_m": record["outside_blocks"]["standard_deviation_m"],
        "sha256": tile["sha256"],
    }


def _cell(record: Record) -> dict[str, Any]:
    """Return the keys of images and annotations that say which epoch they come from."""
    epoch = record["epoch"]
    return {
        "sensor": epoch["sensor"],
        "wall": epoch["wall"],
        "noise": epoch["noise"],
        "size_class": epoch["size"],
        "seed": record["seed"],
        "source": record["source"],
        "epoch": epoch["index"],
    }


def _compact(value: Any) -> str:
    """Format JSON without spaces."""
    return json.dumps(value, allow_nan=False, separators=(",", ":"))
