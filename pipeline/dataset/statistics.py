"""What the card tells of a set, gathered shard by shard in bounded memory."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIZE_EDGES_M = np.geomspace(0.04, 6.0, 81)
Cell = tuple[str, str, str, str, str]
"""Split, sensor, wall, noise, size class."""


@dataclass
class CellStatistics:
    """Of one combination. noise_m: StD outside the blocks of each epoch; sizes: annotations per bin of SIZE_EDGES_M."""

    tiles: int = 0
    annotations: int = 0
    noise_m: list[float] = field(default_factory=list)
    sizes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(SIZE_EDGES_M) - 1, dtype=np.int64))


@dataclass(frozen=True)
class Sample:
    """A tile to show. file: relative to the set's folder; record: its entry in the shard."""

    cell: Cell
    file: str
    tile: dict[str, Any]
    noise_m: float


class SetStatistics:
    """The cells of a set, and a sample tile of each sensor, noise and size class."""

    def __init__(self) -> None:
        self.cells: dict[Cell, CellStatistics] = defaultdict(CellStatistics)
        self.samples: dict[tuple[str, str, str], Sample] = {}
        self.seeds: set[int] = set()

    def add(self, record: dict[str, Any]) -> None:
        """Count an epoch."""
        epoch = record["epoch"]
        key = epoch["split"], epoch["sensor"], epoch["wall"], epoch["noise"], epoch["size"]
        cell = self.cells[key]
        annotations = [annotation for tile in record["tiles"] for annotation in tile["annotations"]]
        cell.tiles += len(record["tiles"])
        cell.annotations += len(annotations)
        noise = record["outside_blocks"]["standard_deviation_m"]
        if noise is not None:
            cell.noise_m.append(noise)
        sizes = [float(np.mean(annotation["size_m"])) for annotation in annotations]
        cell.sizes += np.histogram(np.clip(sizes, SIZE_EDGES_M[0], SIZE_EDGES_M[-1]), SIZE_EDGES_M)[0]
        self.seeds.add(record["seed"])
        shown = key[1], key[3], key[4]
        if shown not in self.samples:
            tile = max(record["tiles"], key=lambda each: (len(each["annotations"]), each["image"]["file_name"]))
            self.samples[shown] = Sample(key, f"{epoch['split']}/{tile['image']['file_name']}", tile, noise or 1e-3)
