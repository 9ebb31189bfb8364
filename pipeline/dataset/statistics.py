"""Gather the statistics for the data set card, shard by shard in bounded memory."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.annotate import DETECTABLE_SNR

SIZE_EDGES_M = np.geomspace(0.04, 6.0, 81)
"""Bin edges of the histogram of block sizes, m."""
_FINER = {"stereo": "a finer depth_map, or reconstruction: vertices", "tls": "finer scanner steps"}
"""How to make the samples of each sensor denser."""
Cell = tuple[str, str, str, str, str]
"""Split, sensor, wall, noise, size class."""


@dataclass
class CellStatistics:
    """Statistics of the tiles with one combination of wall, sensor, noise level, size class and split in a data set.

    Attributes
    ----------
    tiles, annotations : Their numbers.
    with_ratio, stand_out : Annotations with a known signal-to-noise ratio, and those of them whose ratio is so high that the
        block stands out from the noise.
    filled : Sum over the annotations of the share of the bounding box that the mask fills.
    noise_m : Standard deviation outside the blocks of each epoch, m.
    sizes : Number of annotations in each bin of block size; the bins' edges are SIZE_EDGES_M, m.
    """

    tiles: int = 0
    annotations: int = 0
    with_ratio: int = 0
    stand_out: int = 0
    filled: float = 0.0
    noise_m: list[float] = field(default_factory=list)
    sizes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(SIZE_EDGES_M) - 1, dtype=np.int64))


@dataclass(frozen=True)
class ShownTile:
    """A tile that a data set's README shows as an example.

    Attributes
    ----------
    cell : Split, sensor, wall, noise level and size class of the epoch that the tile is cut from.
    file : Path of the tile's difference map, relative to the set's folder.
    tile : Image and annotations of the tile, as stored in the JSON file of its epoch.
    noise_m : Standard deviation of the noise of the difference map of that epoch, m.
    """

    cell: Cell
    file: str
    tile: dict[str, Any]
    noise_m: float


class SetStatistics:
    """Statistics of a data set for its README, collected epoch by epoch.

    Attributes
    ----------
    cells : Statistics of each combination of its properties (wall, noise level, ...).
    samples : Sample tile by sensor, noise level and size class.
    seeds : Seeds of the epochs.
    spacing_m, smallest_m : Largest spacing of ray-traced samples and smallest edge of a block, m, by sensor and wall.
    """

    def __init__(self) -> None:
        self.cells: dict[Cell, CellStatistics] = defaultdict(CellStatistics)
        self.samples: dict[tuple[str, str, str], ShownTile] = {}
        self.seeds: set[int] = set()
        self.spacing_m: dict[tuple[str, str], float] = {}
        self.smallest_m: dict[tuple[str, str], float] = {}

    def add(self, record: dict[str, Any]) -> None:
        """Add an epoch of a data set to the statistics. record: the epoch's record."""
        epoch = record["epoch"]
        key = epoch["split"], epoch["sensor"], epoch["wall"], epoch["noise"], epoch["size"]
        cell = self.cells[key]
        annotations = [annotation for tile in record["tiles"] for annotation in tile["annotations"]]
        cell.tiles += len(record["tiles"])
        cell.annotations += len(annotations)
        ratios = [ratio for each in annotations if (ratio := each.get("signal_to_noise")) is not None]
        cell.with_ratio += len(ratios)
        cell.stand_out += sum(ratio > DETECTABLE_SNR for ratio in ratios)
        cell.filled += sum(each["area"] / (each["bbox"][2] * each["bbox"][3]) for each in annotations)
        noise = record["outside_blocks"]["standard_deviation_m"]
        if noise is not None:
            cell.noise_m.append(noise)
        sizes = [float(np.mean(annotation["size_m"])) for annotation in annotations]
        cell.sizes += np.histogram(np.clip(sizes, SIZE_EDGES_M[0], SIZE_EDGES_M[-1]), SIZE_EDGES_M)[0]
        self.seeds.add(record["seed"])
        if record.get("spacing_m"):
            self._compare_spacing(key[1:3], record["spacing_m"], annotations)
        shown = key[1], key[3], key[4]
        if shown not in self.samples:
            tile = max(record["tiles"], key=lambda each: (len(each["annotations"]), each["image"]["file_name"]))
            self.samples[shown] = ShownTile(key, f"{epoch['split']}/{tile['image']['file_name']}", tile, noise or 1e-3)

    def _compare_spacing(self, place: tuple[str, str], spacing_m: float, annotations: list[dict[str, Any]]) -> None:
        """Update the largest sample spacing and the smallest block edge of a sensor and wall."""
        self.spacing_m[place] = max(spacing_m, self.spacing_m.get(place, 0.0))
        edges = [min(each["size_m"]) for each in annotations]
        self.smallest_m[place] = min([*edges, self.smallest_m.get(place, float("inf"))])

    def warnings(self) -> list[str]:
        """Return a warning for each sensor and wall that is sampled too coarsely for its smallest blocks.

        This is so if fewer than two ray-traced samples fall on the smallest edge of a block.
        """
        return [
            f"{sensor} {wall}: samples are {1e3 * spacing:.0f} mm apart; the smallest block has an edge of {1e3 * edge:.0f} mm. "
            f"Fewer than two samples on it lose depth and rims of small niches; use {_FINER[sensor]}"
            for (sensor, wall), spacing in sorted(self.spacing_m.items())
            if (edge := self.smallest_m[sensor, wall]) < 2 * spacing
        ]
