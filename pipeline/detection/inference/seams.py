"""One answer where tiles overlap: blocks that one tile sees whole as it sees them, larger ones put together from their parts.

Tiles overlap by half of their side, so that a block of less than that side lies whole, and clear of the border, in one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.detection.evaluation.detections import (
    Detection,
    bounds_overlap,
    not_mostly_in,
    shared_pixels,
    united,
    without_doubles,
)

_SAME = 0.6
"""Two parts are of one block where, within the pixels that both tiles see, they share more than this part of the smaller one."""
_MARGIN = 16
"""A detection that ends within this fraction of a tile's side from its border may be cut: networks' masks end short of it."""


@dataclass(frozen=True)
class MapTile:
    """A square of a map. row, column: its first pixel in the map; size: its side, px; shape: of the map."""

    row: int
    column: int
    size: int
    shape: tuple[int, ...]

    @property
    def bounds(self) -> tuple[int, int, int, int]:
        """First and last row and column in the map, the last not in it, px."""
        return self.row, min(self.row + self.size, self.shape[0]), self.column, min(self.column + self.size, self.shape[1])


@dataclass(frozen=True)
class Border:
    """A side of a tile inside the map: the place along `axis`, px, beyond which the tile does not see; step: the way there."""

    axis: int
    place: int
    step: int

    def passed_by(self, item: Detection) -> bool:
        """Whether the detection, in the map's frame, goes on beyond it."""
        first, last = item.bounds[2 * self.axis : 2 * self.axis + 2]
        return first < self.place if self.step < 0 else last > self.place


@dataclass(frozen=True)
class BlockPart:
    """What one tile shows of a block. item: in the map's frame; cuts: the tile's borders that may have cut it."""

    item: Detection
    tile: MapTile
    cuts: tuple[Border, ...]


def part(item: Detection, tile: MapTile) -> BlockPart:
    """A detection in the map's frame, with the borders of the tile that it comes near to."""
    margin = tile.size // _MARGIN
    cuts = []
    for axis in (0, 1):
        (first, last), (begin, end) = (bounds[2 * axis : 2 * axis + 2] for bounds in (item.bounds, tile.bounds))
        if begin > 0 and first <= begin + margin:
            cuts.append(Border(axis, begin, -1))
        if end < tile.shape[axis] and last >= end - margin:
            cuts.append(Border(axis, end, 1))
    return BlockPart(item, tile, tuple(cuts))


def without_seams(parts: Sequence[BlockPart]) -> list[Detection]:
    """The blocks of which the tiles show the parts, each once, best first.

    Parts that a border may have cut are put together with those of other tiles that agree with them where both see. Where a tile
    sees the whole block that counts, whatever the scores. What then still ends at a border is left out if it is so small that
    another tile sees it whole, and did not find it; larger ones stay as far as they were found.
    """
    whole = [each.item for each in parts if not each.cuts]
    joined = [item for item in map(_joined, _groups([each for each in parts if each.cuts])) if item is not None]
    return without_doubles([*whole, *not_mostly_in(joined, whole)])


def _joined(parts: Sequence[BlockPart]) -> Detection | None:
    """The parts of one block as one, None where a tile sees it whole and denies it."""
    item = united([each.item for each in parts])
    ends = [cut for each in parts for cut in each.cuts if not cut.passed_by(item)]
    size = parts[0].tile.size
    seen_whole = size // 2 - 2 * (size // _MARGIN)
    return None if any(item.mask.shape[end.axis] < seen_whole for end in ends) else item


def _groups(parts: Sequence[BlockPart]) -> list[list[BlockPart]]:
    """The parts by the block that they are of: linked, directly or through others, by what they agree on."""
    bounds = np.array([each.item.bounds for each in parts]).reshape(-1, 4)
    group = np.arange(len(parts))
    for number, each in enumerate(parts):
        for other in np.flatnonzero(bounds_overlap(bounds[:number], each.item.bounds)).tolist():
            if group[other] != group[number] and _agree(each, parts[other]):
                group[group == group[other]] = group[number]
    return [[parts[index] for index in np.flatnonzero(group == label).tolist()] for label in np.unique(group)]


def _agree(one: BlockPart, other: BlockPart) -> bool:
    """Whether they come from two tiles and show the same where both tiles see."""
    if one.tile == other.tile:
        return False
    seen = [one.item.pixels_within(other.tile.bounds), other.item.pixels_within(one.tile.bounds)]
    return shared_pixels(one.item, other.item) > _SAME * min(seen)
