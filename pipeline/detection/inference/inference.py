"""Detect blocks in whole difference maps with the network, tile by tile, with consistent results at the seams."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.detection.evaluation.detections import Detection, detection_from_mask
from pipeline.detection.inference.seams import BlockPart, MapTile, block_part, merge_tile_parts, shared_px
from pipeline.detection.network.normalisation import nmad, normalised


def detect(model: Any, difference: NDArray[np.float32], minimum_score: float = 0.5) -> list[Detection]:
    """Detect blocks in a difference map with the network.

    The map is searched in overlapping tiles, so that every block up to the overlap's size is complete in one of them; parts of
    larger blocks are merged. In maps larger than a tile, margins and tiles without data are skipped.

    Parameters
    ----------
    model : A MaskRCNN.
    difference : (h, w) map, m; NaN without data.
    minimum_score : Lowest score of a detection.

    Returns
    -------
    The detections, best first.
    """
    known = np.isfinite(difference)
    if not known.any():
        return []
    (top, bottom), (left, right) = (_data_range(np.asarray(known.any(axis=axis)), model.size) for axis in (1, 0))
    return [item.moved(top, left) for item in _detect_in_tiles(model, difference[top:bottom, left:right], minimum_score)]


def _data_range(known: NDArray[np.bool_], size: int) -> tuple[int, int]:
    """Return the first and the end index of the rows or columns (n,) to search.

    They are all of them, or those with data if the map is larger than `size`.
    """
    if len(known) <= size:
        return 0, len(known)
    there = np.flatnonzero(known)
    return int(there[0]), int(there[-1]) + 1


def _detect_in_tiles(model: Any, difference: NDArray[np.float32], minimum_score: float) -> list[Detection]:
    """Detect blocks in all tiles of a map and merge them."""
    size = model.size
    noise = nmad(difference)
    parts: list[BlockPart] = []
    tiles = [MapTile(row, column, size, difference.shape) for row, column in tile_places(difference.shape, size)]
    for tile in tiles:
        pixels = _pixels(difference, tile)
        if not np.isfinite(pixels).any():
            continue
        image = normalised(pixels, model.config.normalisation, noise)
        # One tile at a time: a batch is not faster on processors, and each further shape of the input is compiled anew.
        answer = {name: values[0] for name, values in model.predict_on_batch({"image": image[None]}).items()}
        parts += [block_part(item, tile) for item in _in_tile(answer, minimum_score, tile)]
    return merge_tile_parts(parts)


def tile_places(shape: tuple[int, ...], size: int) -> Iterator[tuple[int, int]]:
    """Yield the first row and column of overlapping tiles that cover a map, to search it tile by tile.

    shape: (h, w) of the map, px. size: side of a tile, px. Tiles overlap by `shared_px` or more and end flush with the map's
    edge.
    """
    rows, columns = (_starts(length, size) for length in shape)
    return ((row, column) for row in rows for column in columns)


def paste(probability: NDArray[np.float32], box: NDArray[np.float32], size: int) -> tuple[int, int, NDArray[np.bool_]]:
    """Draw a mask that the network predicted on the grid of a box into the image's pixels.

    Values are interpolated bilinearly between the centres of the mask's cells.

    Parameters
    ----------
    probability : (m, m) mask probabilities over the box.
    box : (4,) y0, x0, y1, x1, px; it may reach beyond the image.
    size : Side of the image, px.

    Returns
    -------
    Row and column of the result's first pixel, and the mask of pixels whose centres have a probability above one half.
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
    """Return the starts of overlapping tiles along one axis."""
    if length <= size:
        return [0]
    count = -(-(length - size) // (size - shared_px(size))) + 1
    return [round(number * (length - size) / (count - 1)) for number in range(count)]


def _pixels(difference: NDArray[np.float32], tile: MapTile) -> NDArray[np.float32]:
    """Return the (size, size) pixels of a tile, NaN beyond the map."""
    cut = difference[tile.row : tile.row + tile.size, tile.column : tile.column + tile.size]
    missing = [(0, tile.size - length) for length in cut.shape]
    return np.pad(cut, missing, constant_values=np.nan)


def _in_tile(answer: dict[str, NDArray[Any]], minimum_score: float, tile: MapTile) -> Iterator[Detection]:
    """Yield the network's detections in a tile, in the map's frame."""
    top, bottom, left, right = tile.bounds
    for box, score, mask in zip(answer["mask_boxes"], answer["scores"], answer["masks"], strict=True):
        if score < minimum_score:
            return
        row, column, pixels = paste(mask, box, tile.size)
        item = detection_from_mask(
            pixels[: max(bottom - top - row, 0), : max(right - left - column, 0)], row, column, float(score)
        )
        if item is not None:
            yield item.moved(top, left)
