"""What the card tells of a set, gathered shard by shard in bounded memory."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.annotate import DETECTABLE_SNR

SIZE_EDGES_M = np.geomspace(0.04, 6.0, 81)
_FINER = {"stereo": "a finer depth_map, or reconstruction: vertices", "tls": "finer scanner steps"}
Cell = tuple[str, str, str, str, str]
"""Split, sensor, wall, noise, size class."""


@dataclass
class CellStatistics:
    """Of one combination. noise_m: StD outside the blocks of each epoch; sizes: annotations per bin of SIZE_EDGES_M; with_ratio,
    stand_out: annotations whose signal-to-noise ratio is known, and above STANDS_OUT; filled: sum of the shares of their bounding
    boxes that they fill."""

    tiles: int = 0
    annotations: int = 0
    with_ratio: int = 0
    stand_out: int = 0
    filled: float = 0.0
    noise_m: list[float] = field(default_factory=list)
    sizes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(SIZE_EDGES_M) - 1, dtype=np.int64))


@dataclass(frozen=True)
class ShownTile:
    """A tile to show. file: relative to the set's folder; record: its entry in the shard."""

    cell: Cell
    file: str
    tile: dict[str, Any]
    noise_m: float


class SetStatistics:
    """The cells of a set, and a sample tile of each sensor, noise and size class."""

    def __init__(self) -> None:
        self.cells: dict[Cell, CellStatistics] = defaultdict(CellStatistics)
        self.samples: dict[tuple[str, str, str], ShownTile] = {}
        self.seeds: set[int] = set()
        self.spacing_m: dict[tuple[str, str], float] = {}
        self.smallest_m: dict[tuple[str, str], float] = {}

    def add(self, record: dict[str, Any]) -> None:
        """Count an epoch."""
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
        self.spacing_m[place] = max(spacing_m, self.spacing_m.get(place, 0.0))
        edges = [min(each["size_m"]) for each in annotations]
        self.smallest_m[place] = min([*edges, self.smallest_m.get(place, float("inf"))])

    def warnings(self) -> list[str]:
        """What is amiss with ray-traced samples: fewer than two along the smallest edge of a block."""
        return [
            f"{sensor} {wall}: samples are {1e3 * spacing:.0f} mm apart, the smallest block has an edge of {1e3 * edge:.0f} mm: "
            f"less than two samples a smallest edge, which lose depth and rims of small niches; take {_FINER[sensor]}"
            for (sensor, wall), spacing in sorted(self.spacing_m.items())
            if (edge := self.smallest_m[sensor, wall]) < 2 * spacing
        ]
