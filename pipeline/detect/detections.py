"""Blocks found in a difference map, whoever found them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.annotate import BLOCK_CATEGORY, run_length_encoding

_COVERED = 0.6
"""Of two detections that share more than this part of the smaller one, the better stays."""


@dataclass(frozen=True)
class Detection:
    """One block. row, column: px, the mask's top-left pixel in the map; mask: (h, w) bool; score: 0...1."""

    row: int
    column: int
    mask: NDArray[np.bool_]
    score: float

    @property
    def area_px(self) -> int:
        """Pixels of the mask."""
        return int(np.count_nonzero(self.mask))

    def moved(self, row: int, column: int) -> Detection:
        """The same in a larger frame, in which this one's pixel (0, 0) is (row, column)."""
        return Detection(self.row + row, self.column + column, self.mask, self.score)

    def annotation(self, number: int, image_id: int, shape: tuple[int, ...]) -> dict[str, Any]:
        """As COCO holds a result, with an id and the box, so that it is an annotation too; shape: of the map."""
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


def cropped(mask: NDArray[np.bool_], row: int, column: int, score: float) -> Detection | None:
    """A detection of the set pixels of `mask` (h, w), whose top-left pixel is (row, column); None where there are none."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    inner = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Detection(row + int(rows[0]), column + int(columns[0]), inner, score)


def without_doubles(found: Iterable[Detection]) -> list[Detection]:
    """Best first; a detection that shares most of its pixels, or of the other's, with a better one is left out."""
    kept: list[Detection] = []
    for candidate in sorted(found, key=lambda item: (-item.score, item.row, item.column)):
        if all(_shared(candidate, better) <= _COVERED * min(candidate.area_px, better.area_px) for better in kept):
            kept.append(candidate)
    return kept


def _shared(left: Detection, right: Detection) -> int:
    """Pixels of both masks."""
    top, bottom = max(left.row, right.row), min(left.row + left.mask.shape[0], right.row + right.mask.shape[0])
    first, last = max(left.column, right.column), min(left.column + left.mask.shape[1], right.column + right.mask.shape[1])
    if top >= bottom or first >= last:
        return 0
    parts = (item.mask[top - item.row : bottom - item.row, first - item.column : last - item.column] for item in (left, right))
    one, other = parts
    return int(np.count_nonzero(one & other))
