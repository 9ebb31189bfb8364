"""Merge detections of overlapping tiles into one per block: complete ones as they are, larger blocks joined from their parts.

Tiles overlap by `shared_px`. A block smaller than that is complete in at least one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.detection.evaluation.detections import (
    Detection,
    bounds_overlap,
    merged,
    not_covered_by,
    shared_pixels,
    without_duplicates,
)

_SAME = 0.6
"""Share of the smaller part's pixels, within the area that both tiles see, above which two parts belong to the same block."""
_MARGIN = 16
"""A detection may be cut if it ends nearer to the border than this fraction of the tile's side; masks often end short of the
border.
"""


def shared_px(size: int) -> int:
    """Return the least overlap of neighbouring tiles in detection, px: a quarter of their side `size`.

    Half of the side would take nearly twice as many tiles for less than half a point of F1 (docs/validation/detector.md).
    """
    return size // 4


@dataclass(frozen=True)
class MapTile:
    """A square of a map in which the network searches for blocks.

    row, column: its first pixel in the map; size: its side, px; shape: (h, w) of the map.
    """

    row: int
    column: int
    size: int
    shape: tuple[int, ...]

    @property
    def bounds(self) -> tuple[int, int, int, int]:
        """First row, end row, first column and end column of the tile in the map, px; the ends are exclusive."""
        return self.row, min(self.row + self.size, self.shape[0]), self.column, min(self.column + self.size, self.shape[1])


@dataclass(frozen=True)
class Border:
    """A side of a tile that is not the map's edge, and so may cut a block in two.

    Attributes
    ----------
    axis : 0 for an upper or lower side, along a row; 1 for a left or right side, along a column.
    place : Row or column of the map at which the side lies.
    step : Direction from the side to the outside of the tile: -1 up or left, 1 down or right.
    """

    axis: int
    place: int
    step: int

    def passed_by(self, item: Detection) -> bool:
        """Whether a detection extends beyond this border of a tile. item: the detection, in pixels of the whole map."""
        first, last = item.bounds[2 * self.axis : 2 * self.axis + 2]
        return first < self.place if self.step < 0 else last > self.place


@dataclass(frozen=True)
class BlockPart:
    """A block as one tile shows it, perhaps only the part inside the tile.

    Attributes
    ----------
    item : The detection, in pixels of the whole map.
    tile : The tile.
    cuts : Borders of the tile that may have cut the block.
    """

    item: Detection
    tile: MapTile
    cuts: tuple[Border, ...]


def block_part(item: Detection, tile: MapTile) -> BlockPart:
    """Find which borders of a tile may have cut a block that was detected in it.

    item: the detection, in pixels of the whole map. tile: the tile.
    """
    margin = tile.size // _MARGIN
    cuts = []
    for axis in (0, 1):
        (first, last), (begin, end) = (bounds[2 * axis : 2 * axis + 2] for bounds in (item.bounds, tile.bounds))
        if begin > 0 and first <= begin + margin:
            cuts.append(Border(axis, begin, -1))
        if end < tile.shape[axis] and last >= end - margin:
            cuts.append(Border(axis, end, 1))
    return BlockPart(item, tile, tuple(cuts))


def merge_tile_parts(parts: Sequence[BlockPart]) -> list[Detection]:
    """Merge the detections of all tiles into one per block, best first.

    Parts that a border may have cut are joined with parts of other tiles that agree with them in their common area. A detection
    that is complete in a tile wins, whatever its score. A joined detection that still ends at a border is dropped if it is so
    small that another tile sees it completely but did not detect it; larger ones are kept as they are.
    """
    whole = [each.item for each in parts if not each.cuts]
    joined = [item for item in map(_joined, _groups([each for each in parts if each.cuts])) if item is not None]
    return without_duplicates([*whole, *not_covered_by(joined, whole)])


def _joined(parts: Sequence[BlockPart]) -> Detection | None:
    """Join the parts of one block; None if a tile that sees the whole block did not detect it."""
    item = merged([each.item for each in parts])
    ends = [cut for each in parts for cut in each.cuts if not cut.passed_by(item)]
    size = parts[0].tile.size
    seen_whole = shared_px(size) - 2 * (size // _MARGIN)
    return None if any(item.mask.shape[end.axis] < seen_whole for end in ends) else item


def _groups(parts: Sequence[BlockPart]) -> list[list[BlockPart]]:
    """Group the parts by block: parts that agree, directly or through others."""
    bounds = np.array([each.item.bounds for each in parts]).reshape(-1, 4)
    group = np.arange(len(parts))
    for number, each in enumerate(parts):
        for other in np.flatnonzero(bounds_overlap(bounds[:number], each.item.bounds)).tolist():
            if group[other] != group[number] and _agree(each, parts[other]):
                group[group == group[other]] = group[number]
    return [[parts[index] for index in np.flatnonzero(group == label).tolist()] for label in np.unique(group)]


def _agree(one: BlockPart, other: BlockPart) -> bool:
    """Whether two parts of different tiles show the same block in their common area."""
    if one.tile == other.tile:
        return False
    seen = [one.item.pixels_within(other.tile.bounds), other.item.pixels_within(one.tile.bounds)]
    return shared_pixels(one.item, other.item) > _SAME * min(seen)
