"""Show a split of a data set tile by tile, with the differences themselves as relief."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.detection.network.data import CocoFolder
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.report.figures import SCALE_SIGMAS, mean_pooled
from pipeline.view.results import Item, Layer, Patch, PointLayer, ViewWindow, centres, cut

_MM = 1e3
_SIGMA_M = 0.01
"""Noise that sets the colour scale if a tile does not state its own, m."""


class TileResults:
    """A split of a data set (train, val or test), as `scarpsim view` shows it in the browser.

    The user moves from tile to tile, the images of difference maps, and selects annotated blocks. For the class
    `Results`, the interface of the viewer, each tile is a `step`, and each block an `item`.
    """

    step_name = "tile"
    surfaces = {"relief": "difference, as relief (rock that is missing lies deep)"}  # noqa: RUF012

    def __init__(self, folder: Path) -> None:
        """Read the folder. Raises InputError if annotations.json cannot be used."""
        self.folder, self._coco = folder, CocoFolder(folder, masks=False)
        self.title = f"{folder.parent.name}/{folder.name}: {len(self._coco)} tiles"
        self._images = {str(image["id"]): image for image in self._coco.images}
        self.steps = {key: str(image["file_name"]) for key, image in self._images.items()}
        self._map = lru_cache(8)(read_geotiff)

    def layers(self, step: str) -> list[Layer]:
        """Return the only quantity that can colour a tile (`step`), the difference of two epochs."""
        sigma = _number(self._images[step].get("noise_sigma_m")) or _SIGMA_M
        return [
            Layer(
                "difference",
                "reference minus epoch (missing rock positive)",
                "mm",
                _MM,
                diverging=True,
                limit=SCALE_SIGMAS * sigma * _MM,
            )
        ]

    def patch(self, step: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """Return a part of a tile, with the difference of the two epochs as colour and, with its sign reversed, as relief.

        step: key of the tile. window: part of it; None: all. budget: approximate upper limit on the number of cells.
        `surface` and `layer` have no effect, as there is one of each.
        """
        values, grid = self._map(self._coco.path(self._images[step]))
        rows, columns, factor = cut(grid, window, budget)
        shown = mean_pooled(values[rows, columns], factor)
        return Patch(*centres(grid, rows, columns, factor), -shown, shown * _MM, np.zeros(shown.shape, int), factor)

    def points(self, step: str, layer: Layer, window: ViewWindow | None, budget: int) -> PointLayer | None:
        """Return None, as a data set contains difference maps but no measured points; all arguments have no effect."""
        return None

    def items(self, step: str) -> list[Item]:
        """Return the annotated blocks of a tile; `step` is its key."""
        grid = self._map(self._coco.path(self._images[step]))[1]
        found = [each for each in self._coco.annotations if each["image_id"] == self._images[step]["id"]]
        return [_block(each, grid.x_min, grid.y_max, grid.gsd) for each in found]


def _number(value: Any) -> float | None:
    """Return the value if it is a finite number of at least 0, else None; other programs may write anything here."""
    return value if isinstance(value, int | float) and 0 <= value < np.inf else None


def _block(annotation: dict[str, Any], x_min: float, y_max: float, gsd: float) -> Item:
    """Convert an annotation to an item."""
    column, row, width, height = annotation["bbox"]
    x0, y1 = x_min + column * gsd, y_max - row * gsd
    known = {"volume_m3": "m³", "measured_volume_m3": "m³", "depth_m": "m", "share_in_tile": ""}
    facts = {
        key.removesuffix("_m3").removesuffix("_m").replace("_", " "): f"{value:.4g} {unit}".strip()
        for key, unit in known.items()
        if (value := _number(annotation.get(key))) is not None
    }
    facts |= {"shape": str(annotation["shape"])} if "shape" in annotation else {}
    box = (x0, x0 + width * gsd, y1 - height * gsd, y1, np.nan, np.nan)
    return Item("block", f"block {annotation.get('block', annotation['id'])}", box, facts)
