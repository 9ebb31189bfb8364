"""Detection in whole difference maps: tiles with overlap, and one answer at their seams."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.detection.evaluation.detections import Detection, cropped
from pipeline.detection.inference.seams import BlockPart, MapTile, part, without_seams
from pipeline.detection.network.normalisation import nmad, normalised

_BATCH = 4


def detect(model: Any, difference: NDArray[np.float32], minimum_score: float = 0.5) -> list[Detection]:
    """The blocks in a difference map (h, w), m, NaN where there are no data, best first.

    model: a MaskRCNN. Tiles overlap by a half of their side, so that every block of up to that size lies whole in one of them;
    `seams` says what becomes of the blocks that a tile's inner border cuts. Margins without data are not searched where a map is
    larger than a tile.
    """
    known = np.isfinite(difference)
    if not known.any():
        return []
    (top, bottom), (left, right) = (_searched_along(np.asarray(known.any(axis=axis)), model.size) for axis in (1, 0))
    return [item.moved(top, left) for item in _searched(model, difference[top:bottom, left:right], minimum_score)]


def _searched_along(known: NDArray[np.bool_], size: int) -> tuple[int, int]:
    """From and to where the rows or columns (n,) that have data are searched, with tiles of side `size`."""
    if len(known) <= size:
        return 0, len(known)
    there = np.flatnonzero(known)
    return int(there[0]), int(there[-1]) + 1


def _searched(model: Any, difference: NDArray[np.float32], minimum_score: float) -> list[Detection]:
    size = model.size
    noise = nmad(difference)
    parts: list[BlockPart] = []
    tiles = [MapTile(row, column, size, difference.shape) for row, column in tile_places(difference.shape, size)]
    for group in _batches(tiles):
        images = [normalised(_pixels(difference, tile), model.config.normalisation, noise) for tile in group]
        answers = model.predict_on_batch({"image": np.stack(images)})
        for number, tile in enumerate(group):
            answer = {name: values[number] for name, values in answers.items()}
            parts += [part(item, tile) for item in _in_tile(answer, minimum_score, tile)]
    return without_seams(parts)


def _batches(tiles: list[MapTile]) -> Iterator[list[MapTile]]:
    """Whole batches, and what is left over tile by tile: two shapes, so that two functions are compiled, and nothing in vain."""
    whole = len(tiles) // _BATCH * _BATCH
    yield from (tiles[first : first + _BATCH] for first in range(0, whole, _BATCH))
    yield from ([tile] for tile in tiles[whole:])


def tile_places(shape: tuple[int, ...], size: int) -> Iterator[tuple[int, int]]:
    """(row, column) of tiles of side `size` that overlap by a half and end flush with the map where it is larger than a tile."""
    rows, columns = (_starts(length, size) for length in shape)
    return ((row, column) for row in rows for column in columns)


def paste(probability: NDArray[np.float32], box: NDArray[np.float32], size: int) -> tuple[int, int, NDArray[np.bool_]]:
    """Row, column and mask of the pixels of an image of side `size` whose centres have a probability above a half.

    probability: (m, m) over the box (y0, x0, y1, x1), px, which may reach beyond the image. It is interpolated bilinearly between
    the centres of its cells; pixels that the box does not touch have none.
    """
    y0, x0, y1, x1 = (float(value) for value in box)
    top, left = max(int(np.floor(y0)), 0), max(int(np.floor(x0)), 0)
    bottom, right = min(int(np.ceil(y1)), size), min(int(np.ceil(x1)), size)
    cells = probability.shape[0]
    rows = (np.arange(top, bottom, dtype=np.float32) + 0.5 - y0) / max(y1 - y0, 1e-6) * cells - 0.5
    columns = (np.arange(left, right, dtype=np.float32) + 0.5 - x0) / max(x1 - x0, 1e-6) * cells - 0.5
    if not len(rows) or not len(columns):
        return top, left, np.zeros((0, 0), bool)
    x, y = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    values = cv2.remap(probability, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return top, left, values > 0.5


def _starts(length: int, size: int) -> list[int]:
    if length <= size:
        return [0]
    count = -(-(length - size) // (size // 2)) + 1
    return [round(number * (length - size) / (count - 1)) for number in range(count)]


def _pixels(difference: NDArray[np.float32], tile: MapTile) -> NDArray[np.float32]:
    """(size, size) what the tile shows, NaN beyond the map."""
    cut = difference[tile.row : tile.row + tile.size, tile.column : tile.column + tile.size]
    missing = [(0, tile.size - length) for length in cut.shape]
    return np.pad(cut, missing, constant_values=np.nan)


def _in_tile(answer: dict[str, NDArray[Any]], minimum_score: float, tile: MapTile) -> Iterator[Detection]:
    """What the network found in the tile, in the map's frame."""
    top, bottom, left, right = tile.bounds
    for box, score, mask in zip(answer["mask_boxes"], answer["scores"], answer["masks"], strict=True):
        if score < minimum_score:
            return
        row, column, pixels = paste(mask, box, tile.size)
        item = cropped(pixels[: max(bottom - top - row, 0), : max(right - left - column, 0)], row, column, float(score))
        if item is not None:
            yield item.moved(top, left)
