"""Write the data set card: README.md of the folder and its pictures. The same set gives the same bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.dataset.plan import SPLITS
from pipeline.dataset.statistics import SIZE_EDGES_M, SetStatistics
from pipeline.formats.files.atomic import write_bytes, write_text
from pipeline.formats.files.inside import inside

README, CARD = "README.md", "card"
_LOADING = """## Loading

The folder of a split is the folder of its images; `file_name` is relative to it.

    from pycocotools.coco import COCO                       # pycocotools
    coco = COCO("{split}/annotations.json")

    import os, tifffile, torch
    from torchvision.datasets import CocoDetection          # torchvision; its own loader makes 8-bit RGB, which loses the metres:
    class Tiles(CocoDetection):
        def _load_image(self, id):
            path = os.path.join(self.root, self.coco.loadImgs(id)[0]["file_name"])
            return torch.from_numpy(tifffile.imread(path))[None]
    tiles = Tiles("{split}", "{split}/annotations.json")

    import fiftyone as fo                                   # FiftyOne
    fo.Dataset.from_dir(dataset_type=fo.types.COCODetectionDataset, data_path="{split}", labels_path="{split}/annotations.json")

    from pipeline import Tiles                              # scarpsim: NumPy and tf.data
    for sample in Tiles("{split}", noise="{noise}"): ...    # sample.image (h, w), sample.valid, sample.boxes, sample.masks
    Tiles("{split}").tf_dataset().shuffle(100).prefetch(2)
"""
_TILES = """## A tile

Float32 TIFF, one band: reference minus epoch in metres, missing rock positive, NaN where there is no data. A second page is the
validity mask (a TIFF transparency mask of one bit a pixel: `rasterio.open(f).dataset_mask()`, page 1 in tifffile). Tie point and
pixel scale give its place on the wall in the wall frame (x along the wall, y up the wall, metres), as do `x_min_m`, `y_max_m` and
`gsd_m` of the image's entry; `row` and `column` are its first pixel in the epoch's difference map.

In addition to COCO's keys, an annotation has `size_m` (the block's three axes), `volume_m3` (rock removed),
`measured_volume_m3` and `depth_m` (volume and mean depth that the epoch's map shows of the whole block), `signal_to_noise` (of
a matched filter that knows the niche's shape), `ignore` (1 where that is below the config's annotation.ignore_below: training
leaves the block out of its loss, evaluations count it; `iscrowd` stays 0), `share_in_tile` (of the block's pixels; less than 1
at a tile's edge), `shape`, `sensor`, `wall`, `noise`, `size_class`, `seed`, `epoch` (index in the plan) and `source`.
"""


_SURFACES = {
    "direct": "ray-traced samples, triangulated in the sensor's grid (direct)",
    "vertices": "the wall's own vertices, each measured by the pair (vertices: the thesis's method 2)",
    "colmap": "depth maps fused by COLMAP (colmap)",
}
"""Description of each way to make a surface."""


def write_card(
    folder: Path, dataset: dict[str, Any], statistics: SetStatistics, digests: dict[str, str], *, complete: bool
) -> list[str]:
    """Write a data set's README.md (its data card) with figures, and return the names of the written files.

    Parameters
    ----------
    folder : Folder of the set.
    dataset : Content of dataset.json.
    statistics : Statistics of the set.
    digests : SHA-256 checksums of all files of the set that are not written here, by name.
    complete : Whether the set is complete.
    """
    from pipeline.dataset.figures import noise_figure, sizes_figure

    pictures = {
        f"{CARD}/sizes.png": sizes_figure(_sizes(statistics), SIZE_EDGES_M),
        f"{CARD}/noise.png": noise_figure(_noise(statistics)),
    }
    pictures |= {f"{CARD}/samples_{sensor}.png": data for sensor, data in _samples(folder, statistics)}
    for name, data in pictures.items():
        write_bytes(folder / name, data)
    write_text(folder / README, "\n".join(_readme(dataset, statistics, digests, list(pictures), complete)))
    return [README, *pictures]


def _readme(
    dataset: dict[str, Any], statistics: SetStatistics, digests: dict[str, str], pictures: list[str], complete: bool
) -> Iterator[str]:
    """Yield the parts of README.md."""
    tiles = sum(cell.tiles for cell in statistics.cells.values())
    annotations = sum(cell.annotations for cell in statistics.cells.values())
    yield f"# {dataset['name']}\n"
    if not complete:
        yield "**Incomplete: the job was interrupted. The command below continues it.**\n"
    yield f"Simulated difference maps of rock walls with annotated rockfalls: {tiles:,} tiles, {annotations:,} annotations.\n"
    yield from _table(statistics)
    yield "Noise: mean over the epochs of the StD of the difference map outside the blocks. S/N > 4: blocks that a matched filter"
    yield "with their known shape separates from the noise, which is about what any detector could find."
    yield "Niche / box: the share of its bounding box that a niche fills, on average.\n"
    yield from _surfaces(dataset, statistics)
    yield from _series(dataset)
    yield from (f"![{_in_words(name)}]({name})\n" for name in pictures)
    yield "In the samples, red is missing rock, blue a surface that stands further out; the colours end at six times the noise."
    yield "Black outlines are the annotated masks, grey is no data.\n"
    yield from (_split_rules(dataset), _TILES, _loading(statistics))
    yield from _making(dataset, digests)


def _table(statistics: SetStatistics) -> Iterator[str]:
    """Yield the lines of the table with one row for each combination."""
    yield "| split | sensor | wall | noise | size | epochs | tiles | blocks a tile | noise, mm | S/N > 4, % | niche / box, % |"
    yield "|---|---|---|---|---|---|---|---|---|---|---|"
    for key in sorted(statistics.cells, key=lambda cell: (SPLITS.index(cell[0]), cell[1:])):
        cell = statistics.cells[key]
        noise = f"{1e3 * np.mean(cell.noise_m):.1f}" if cell.noise_m else "-"
        known = cell.annotations and cell.with_ratio
        bound = f"{100 * cell.stand_out / cell.with_ratio:.0f} | {100 * cell.filled / cell.annotations:.0f}" if known else "- | -"
        figures = f"{len(cell.noise_m)} | {cell.tiles} | {cell.annotations / max(cell.tiles, 1):.1f} | {noise} | {bound}"
        yield f"| {' | '.join(key)} | {figures} |"
    yield ""


def _surfaces(dataset: dict[str, Any], statistics: SetStatistics) -> Iterator[str]:
    """Describe how the surfaces are made, with warnings where ray-traced samples are too coarse for the smallest blocks."""
    yield (
        "Surfaces: " + "; ".join(f"{words}, of {', '.join(whose)}" for words, whose in _reconstructions(dataset).items()) + ".\n"
    )
    yield from (f"**{warning}**\n" for warning in statistics.warnings())


def _series(dataset: dict[str, Any]) -> Iterator[str]:
    """Say which walls have time series, and what is annotated in them."""
    walls = {name: wall for source in dataset["sources"].values() for name, wall in source["config"]["walls"].items()}
    series = {name: wall["series"] for name, wall in walls.items() if wall.get("series")}
    if not series:
        return
    other = "moved blocks and fallen fragments"
    kinds = any(each["kinds"] for each in series.values())
    rule = f"{other} have categories of their own" if kinds else f"{other} are changes without an annotation"
    yield f"The epochs of {', '.join(series)} are those of time series. Rock that has fallen since the reference is annotated;"
    yield f"{rule}.\n"


def _reconstructions(dataset: dict[str, Any]) -> dict[str, list[str]]:
    """Return sensors and walls by the description of their surfaces."""
    found: dict[str, list[str]] = {}
    for source in dataset["sources"].values():
        for sensor in source["config"]["sensors"]:
            for name, wall in source["config"]["walls"].items():
                way = wall.get("reconstruction", "direct") if sensor == "stereo" else "direct"
                found.setdefault(_SURFACES[way], []).append(f"{sensor} {name}")
    return {words: list(dict.fromkeys(whose)) for words, whose in found.items()}


def _in_words(picture: str) -> str:
    """Return the alternative text of a picture."""
    name = Path(picture).stem
    words = {"sizes": "Histograms of the blocks' sizes", "noise": "Histograms of the epochs' noise"}
    return words.get(name) or f"Sample tiles ({name.removeprefix('samples_')}) with their annotations outlined"


def _loading(statistics: SetStatistics) -> str:
    """Return the loading examples for the first split and noise level of the set."""
    filled = (key for key, found in statistics.cells.items() if found.tiles)
    first = min(filled, key=lambda key: SPLITS.index(key[0]), default=("train", "", "", "usual", ""))
    return _LOADING.format(split=first[0], noise=first[3])


def _split_rules(dataset: dict[str, Any]) -> str:
    """Describe how the splits are separated."""
    shares = sorted({source["config"]["validation_region"] for source in dataset["sources"].values()})
    told = ", ".join(f"{100 * share:.0f} %" for share in shares)
    apart = (
        "Training and validation tiles come from different epochs and from different parts of a wall: the right\n"
        f"end of each wall ({told} of its columns of tiles) is for validation only, so that their tiles never overlap."
    )
    together = "Training and validation tiles come from different epochs, but not everywhere from different parts of a wall."
    rest = "Test tiles come from\nepochs of their own, from the whole wall."
    return f"## Splits\n\n{apart if all(shares) else together} {rest}\n"


def _making(dataset: dict[str, Any], digests: dict[str, str]) -> Iterator[str]:
    """Describe how the set was made, with versions and checksums."""
    yield "## How it was made\n"
    for name, source in dataset["sources"].items():
        yield f"    {source['command'] or 'scarpsim dataset dataset.json --out DIR'}\n"
        versions = ", ".join(f"{key} {value}" for key, value in source["versions"].items())
        yield f"Source {name}, seed {source['config']['seed']}; {versions}.\n"
    if len(dataset["sources"]) == 1:
        yield "`scarpsim dataset dataset.json --out DIR` makes the same bytes again; the resolved config is in dataset.json.\n"
    yield "## Checksums\n"
    yield "`sha256sum -c checksums.sha256` checks every file; `scarpsim dataset verify .` also repairs damaged tiles.\n"
    listing = "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items()) if name.endswith(".tif"))
    yield "| what | SHA-256 |\n|---|---|"
    yield f"| list of all tiles | {hashlib.sha256(listing.encode()).hexdigest()} |"
    yield from (f"| {name} | {digest} |" for name, digest in sorted(digests.items()) if name.endswith(".json"))
    yield ""


def _sizes(statistics: SetStatistics) -> dict[str, Any]:
    """Return the histogram of block sizes by size class."""
    names = dict.fromkeys(key[4] for key in statistics.cells)
    return {name: sum(cell.sizes for key, cell in statistics.cells.items() if key[4] == name) for name in names}


def _noise(statistics: SetStatistics) -> dict[str, list[float]]:
    """Return the noise of each epoch, m, by sensor and noise level."""
    names = dict.fromkeys((key[1], key[3]) for key in statistics.cells)
    return {
        f"{sensor}, {noise}": [
            value for key, cell in statistics.cells.items() if (key[1], key[3]) == (sensor, noise) for value in cell.noise_m
        ]
        for sensor, noise in names
    }


def _samples(folder: Path, statistics: SetStatistics) -> Iterator[tuple[str, bytes]]:
    """Yield a picture for each sensor, with noise levels as rows and size classes as columns."""
    from pipeline.dataset.figures import SampleTile, samples_figure
    from pipeline.dataset.loaders import masks_of
    from pipeline.formats.rasters.geotiff import read_tiff

    def shown(key: tuple[str, str, str]) -> SampleTile:
        sample = statistics.samples[key]
        values = read_tiff(inside(folder, sample.file, folder))
        masks = masks_of(sample.tile["annotations"], values.shape)
        return SampleTile(f"{sample.cell[2]}, {key[1]}, {key[2]}", values, np.any(masks, axis=0, keepdims=False), sample.noise_m)

    for sensor in dict.fromkeys(key[0] for key in statistics.samples):
        levels = dict.fromkeys(key[1] for key in statistics.samples if key[0] == sensor)
        rows = [[shown(key) for key in statistics.samples if key[:2] == (sensor, level)] for level in levels]
        yield sensor, samples_figure(rows)
