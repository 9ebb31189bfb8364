"""Detections of blocks in a difference map, by whatever detector, and operations on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.annotate import BLOCK_CATEGORY, run_length_encoding

_COVERED = 0.6
"""Share of the smaller detection's pixels above which two detections are of the same block, and the better one is kept."""


@dataclass(frozen=True)
class Detection:
    """One detected block, as a mask at its position in a difference map.

    Attributes
    ----------
    row, column : Top-left pixel of the mask in the map.
    mask : (h, w) bool mask of the block, cropped to it.
    score : Confidence, 0 to 1.
    """

    row: int
    column: int
    mask: NDArray[np.bool_]
    score: float

    @property
    def area_px(self) -> int:
        """Number of pixels in the detected block's mask."""
        return int(np.count_nonzero(self.mask))

    @property
    def bounds(self) -> tuple[int, int, int, int]:
        """First row, end row, first column and end column of the mask in the map, px; the ends are exclusive."""
        height, width = self.mask.shape
        return self.row, self.row + height, self.column, self.column + width

    def pixels_within(self, bounds: tuple[int, int, int, int]) -> int:
        """Count the mask's pixels inside `bounds` (first row, end row, first column, end column of the map)."""
        top, bottom, left, right = (max(edge, 0) for edge in np.subtract(bounds, np.repeat((self.row, self.column), 2)))
        return int(np.count_nonzero(self.mask[top:bottom, left:right]))

    def moved(self, row: int, column: int) -> Detection:
        """Return the same detection with its position in a larger image, such as the map from which a tile was cut.

        row, column: position in the larger image of the top-left pixel of the present one.
        """
        return Detection(self.row + row, self.column + column, self.mask, self.score)

    def annotation(self, number: int, image_id: int, shape: tuple[int, ...]) -> dict[str, Any]:
        """Return the detection in COCO's format, to write it to a file.

        It is a COCO result that also has an id and a box, as COCO's annotations have.

        Parameters
        ----------
        number : Id of the annotation.
        image_id : Id of its image.
        shape : (h, w) of the map, px.
        """
        height, width = self.mask.shape
        return {
            "id": number,
            "image_id": image_id,
            "category_id": BLOCK_CATEGORY["id"],
            "bbox": [self.column, self.row, width, height],
            "area": self.area_px,
            "iscrowd": 0,
            "score": round(self.score, 6),
            "segmentation": run_length_encoding(self.mask, self.row, self.column, shape),
        }


def detection_from_mask(mask: NDArray[np.bool_], row: int, column: int, score: float) -> Detection | None:
    """Make a detection from the pixels of a block, cropped to their bounding box.

    Parameters
    ----------
    mask : (h, w) bool, true at the block's pixels.
    row, column : Top-left pixel of `mask` in the map.
    score : Confidence, 0 to 1.

    Returns
    -------
    The detection; None if the mask is empty.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    inner = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Detection(row + int(rows[0]), column + int(columns[0]), inner, score)


def merged(items: Sequence[Detection]) -> Detection:
    """Merge detections of the parts of one block into one, with all their pixels and the best of their scores."""
    bounds = np.array([item.bounds for item in items])
    (top, left), (bottom, right) = bounds[:, ::2].min(axis=0), bounds[:, 1::2].max(axis=0)
    mask = np.zeros((bottom - top, right - left), bool)
    for item, (first, last, begin, end) in zip(items, bounds - np.repeat((top, left), 2), strict=True):
        mask[first:last, begin:end] |= item.mask
    return Detection(int(top), int(left), mask, max(item.score for item in items))


def without_duplicates(found: Iterable[Detection]) -> list[Detection]:
    """Return detections without repeated ones, best score first.

    A detection is dropped if it shares most of its pixels with a better one, or contains most of that one's pixels.
    """
    ranked = sorted(found, key=lambda item: (-item.score, item.row, item.column))
    kept: list[Detection] = []
    bounds = np.empty((len(ranked), 4), np.int64)
    for candidate in ranked:
        near = [kept[index] for index in np.flatnonzero(bounds_overlap(bounds[: len(kept)], candidate.bounds)).tolist()]
        if all(shared_pixels(candidate, better) <= _COVERED * min(candidate.area_px, better.area_px) for better in near):
            bounds[len(kept)] = candidate.bounds
            kept.append(candidate)
    return kept


def not_covered_by(found: Iterable[Detection], others: Sequence[Detection]) -> list[Detection]:
    """Return the detections in `found` that are missing in `others`: none of these covers most of their pixels."""
    bounds = np.array([item.bounds for item in others]).reshape(-1, 4)

    def covered(item: Detection) -> bool:
        near = [others[index] for index in np.flatnonzero(bounds_overlap(bounds, item.bounds)).tolist()]
        return any(shared_pixels(item, other) > _COVERED * item.area_px for other in near)

    return [item for item in found if not covered(item)]


def bounds_overlap(bounds: NDArray[np.int64], other: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Find which of n rectangles overlap another rectangle.

    bounds: (n, 4) first row, end row, first column and end column of each, px; ends are exclusive. other: these four numbers of
    the other rectangle. Returns (n,) bool.
    """
    top, bottom, left, right = bounds.T
    return np.asarray((top < other[1]) & (other[0] < bottom) & (left < other[3]) & (other[2] < right))


def shared_pixels(one: Detection, other: Detection) -> int:
    """Count the pixels of a map that are in the masks of both detections, to tell whether they are of one block."""
    top, bottom = max(one.row, other.row), min(one.bounds[1], other.bounds[1])
    first, last = max(one.column, other.column), min(one.bounds[3], other.bounds[3])
    if top >= bottom or first >= last:
        return 0
    masks = [item.mask[top - item.row : bottom - item.row, first - item.column : last - item.column] for item in (one, other)]
    return int(np.count_nonzero(masks[0] & masks[1]))
