"""Export a data set for Hugging Face's `datasets`: Parquet files of tiles with their blocks.

`load_dataset` and the Hub read them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.dataset.loaders import Sample, Tiles
from pipeline.export.exported_set import splits_of
from pipeline.formats.files.atomic import filling, write_text
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.common.extras import how_to_install

_TILES_A_FILE = 256
"""Tiles per Parquet file."""
_NAMES = {"train": "train", "val": "validation", "test": "test"}
"""The Hub's names of the splits."""
_TEXTS, _NUMBERS = ("sensor", "wall", "noise", "size_class"), ("gsd_m", "x_min_m", "y_max_m", "noise_sigma_m")
_OF_A_BLOCK = ("area", "volume_m3", "depth_m", "signal_to_noise")
"""Properties of a block that are exported as numbers."""
_CARD = """---
pretty_name: {name}
task_categories: [object-detection, image-segmentation]
tags: [rockfall, difference-map, simulated]
configs:
- config_name: default
  data_files:
{files}
---

# {name}

Simulated difference maps of rock walls with annotated rockfalls, made by scarpsim.

    from datasets import load_dataset
    tiles = load_dataset("{name}")          # this folder, or its name on the Hub
    metres = np.asarray(tiles["train"][0]["image"])

- `image`: float32 TIFF, reference minus epoch in metres, missing rock positive, NaN without data.
- `objects`, of each block: `bbox` (x, y, width, height in pixels from the top-left corner), `segmentation` (COCO's compressed run
  lengths: `pycocotools.mask.decode({{"size": [height, width], "counts": s}})`), `area` in px, `volume_m3` of the rock removed,
  `depth_m` and `signal_to_noise` in the map, `ignore`: 1 where the block is below the noise.
- `x_min_m`, `y_max_m`, `gsd_m`: the tile's place on the wall; `noise_sigma_m`: spread of its epoch's map outside the blocks.
"""
"""Text of README.md, the data set's card."""


@dataclass(frozen=True)
class HuggingFaceSet:
    """Result of exporting a data set for Hugging Face.

    folder: where it was written. images, blocks: their numbers by split, with the splits' names on Hugging Face's Hub.
    """

    folder: Path
    images: dict[str, int]
    blocks: dict[str, int]


def save_huggingface(folder: Path, out: Path, progress: Progress) -> HuggingFaceSet:
    """Export a data set for Hugging Face: README.md, and data/SPLIT-00000-of-00002.parquet ... with 256 tiles each.

    The tiles are the data set's own TIFF files, byte for byte. folder: of the data set. out: where to write. progress: receives
    the progress. Raises InputError if the folder contains no split, or if `datasets` (the extra `huggingface`) is not
    installed.
    """
    library, sets = _library(), splits_of(folder)
    blocks: dict[str, int] = {}
    with filling(out) as into, _without_bars(library):
        (into / "data").mkdir()
        for split, tiles in sets.items():
            with progress.stage(split):
                blocks[_NAMES[split]] = _write(library, into / "data" / _NAMES[split], tiles)
        files = "\n".join(f"  - {{split: {_NAMES[split]}, path: data/{_NAMES[split]}-*}}" for split in sets)
        write_text(into / "README.md", _CARD.format(name=out.resolve().name, files=files))
    return HuggingFaceSet(out, {_NAMES[split]: len(tiles) for split, tiles in sets.items()}, blocks)


def _library() -> Any:
    """Import `datasets`. Raises InputError if it is not installed."""
    try:
        import datasets
    except ImportError as error:
        raise InputError(
            f"the export needs the library datasets, which does not load ({error})",
            where="export huggingface",
            remedy=how_to_install("huggingface"),
        ) from None
    return datasets


@contextmanager
def _without_bars(library: Any) -> Iterator[None]:
    """Switch off the library's own progress bars inside the `with` block."""
    shown = not library.are_progress_bars_disabled()
    library.disable_progress_bars()
    try:
        yield
    finally:
        if shown:
            library.enable_progress_bars()


def _write(library: Any, stem: Path, tiles: Tiles) -> int:
    """Write a split's files; return the number of blocks in them."""
    features, files, blocks = _features(library, tiles), -(-len(tiles) // _TILES_A_FILE), 0
    for number in range(files):
        some = range(number * _TILES_A_FILE, min((number + 1) * _TILES_A_FILE, len(tiles)))
        rows = [_row(tiles, tiles[index]) for index in some]
        blocks += sum(len(row["objects"]["id"]) for row in rows)
        path = stem.with_name(f"{stem.name}-{number:05d}-of-{files:05d}.parquet")
        library.Dataset.from_list(rows, features=features).to_parquet(path)
    return blocks


def _features(library: Any, tiles: Tiles) -> Any:
    """Return the types of the columns."""
    whole, number, text = (library.Value(kind) for kind in ("int64", "float64", "string"))
    objects = {
        "id": whole,
        "bbox": library.Sequence(number, length=4),
        "category": library.ClassLabel(names=[str(each.get("name", each["id"])) for each in tiles.categories]),
        "segmentation": text,
        "ignore": whole,
        **dict.fromkeys(_OF_A_BLOCK, number),
    }
    tile = {"image": library.Image(), "image_id": whole, "width": whole, "height": whole, "objects": library.Sequence(objects)}
    return library.Features(tile | dict.fromkeys(_TEXTS, text) | dict.fromkeys(_NUMBERS, number))


def _row(tiles: Tiles, sample: Sample) -> dict[str, Any]:
    """Return the row of one tile."""
    record, blocks = sample.record, sample.annotations
    name, categories = record["file_name"], [each["id"] for each in tiles.categories]
    objects: dict[str, list[Any]] = {
        "id": [each["id"] for each in blocks],
        "bbox": [each["bbox"] for each in blocks],
        "category": [categories.index(each["category_id"]) for each in blocks],
        "segmentation": [each["segmentation"]["counts"] for each in blocks],
        "ignore": [each.get("ignore", 0) for each in blocks],
    }
    return {
        "image": {"bytes": tiles.path_of(record).read_bytes(), "path": name},
        "image_id": record["id"],
        "width": record["width"],
        "height": record["height"],
        "objects": objects | {key: [each.get(key) for each in blocks] for key in _OF_A_BLOCK},
        **{key: record.get(key) for key in (*_TEXTS, *_NUMBERS)},
    }


def summary(made: HuggingFaceSet) -> str:
    """Describe a data set exported for Hugging Face as lines of text: its folder and the numbers of images and blocks."""
    lines = [f"{split}: {images:,} images, {made.blocks[split]:,} blocks" for split, images in made.images.items()]
    return "\n".join([*lines, f"load it with datasets.load_dataset({str(made.folder)!r})"])


def to_dict(made: HuggingFaceSet) -> dict[str, Any]:
    """Return the result of an export for Hugging Face (folder, numbers of images and blocks) as JSON types, for --json."""
    return {"folder": str(made.folder), "images": made.images, "blocks": made.blocks}
