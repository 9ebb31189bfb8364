"""Which blocks a difference map shows: the level of detection of a pixel and of a block, and the curve over block sizes.

A pixel's level of detection is what noise alone exceeds in 5 % of cases: the 95 % quantile of |difference| over stable pixels of
all epochs, in square cells of the wall. It assumes no distribution.

A block of n pixels counts as seen where the mean D of its differences exceeds the level of detection of a mean,

    D > LoD = z s sqrt(V / C(0)),      z = 1.96,   s = level of detection of its pixels / z,

with V the variance of a mean over just these pixels and C(0) that of a pixel, both from the variogram, which carries how far
noise is alike (Rolstad et al. 2009), and s the noise around the block (root mean square over it), which carries that noise
differs over the wall (Hugonnet et al. 2022). A block of which less than half has data, or fewer than four pixels, is not seen.
The test is held against the truth: the same footprints, laid on stable ground, should be taken for blocks in 2.5 % of cases, and
how often they are is reported.

Over the sizes x of the blocks in view the share seen follows P(x) = (1 - l) Phi((ln x - m) / w), by maximum likelihood; l is the
share that no size makes visible, as the niche is hidden even where the block was not. `detection_curve` beside this file fits it.
Blocks that fall out of the sensor's view
are counted apart: no precision helps there, another station does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.noise.variogram import VariogramModel, variance_of_mean
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, IntArray

BoolArray = NDArray[np.bool_]
Z_95 = 1.96
LEAST_PIXELS = 4
LEAST_SHARE = 0.5
"""Of a block's footprint that has to have data."""
LEAST_CELL_PIXELS = 40
"""Stable differences that a cell of the level of detection needs."""
_PLACES = 10
"""Where on the stable ground each footprint is laid."""


def level_of_detection(stable: NDArray[np.floating], cell_px: int) -> NDArray[np.float32]:
    """(h, w) m: the 95 % quantile of |difference| over the stable pixels of a square cell, of all epochs.

    stable: (e, h, w) differences, m, NaN where not stable or without data. Cells with fewer than 40 take the median cell's value;
    all NaN where no cell has so many.
    """
    _, height, width = stable.shape
    rows, columns = -(-height // cell_px), -(-width // cell_px)
    padded = np.full((len(stable), rows * cell_px, columns * cell_px), np.nan, dtype=np.float32)
    padded[:, :height, :width] = np.abs(stable)
    cells = padded.reshape(-1, rows, cell_px, columns, cell_px).transpose(1, 3, 0, 2, 4).reshape(rows * columns, -1)
    ordered = np.sort(cells, axis=1)  # NaN last
    count = np.count_nonzero(~np.isnan(ordered), axis=1)
    place = np.minimum(np.ceil(0.95 * count).astype(int), np.maximum(count, 1)) - 1
    level = np.where(count >= LEAST_CELL_PIXELS, ordered[np.arange(len(ordered)), np.maximum(place, 0)], np.nan)
    middle = np.nanmedian(level) if np.isfinite(level).any() else np.nan
    level = np.where(np.isnan(level), middle, level).reshape(rows, columns)
    return np.repeat(np.repeat(level, cell_px, axis=0), cell_px, axis=1)[:height, :width].astype(np.float32)


@dataclass(frozen=True)
class BlockSeen:
    """What a difference map shows of a block.

    size_m: (2 V)^(1/3) for the rock V that fell, the side of a cube that sat in the rock with half of its height, as
    `scarpsim inspect` plans with; depth_m: true mean depth over its footprint; footprint_px: pixels of the map on
    which it changed the wall; data_share: of these, with data; mean_m: of the differences there, None with too little data;
    limit_m: level of detection of that mean; volume_m3, measured_volume_m3: true, and sum of the differences over the footprint;
    in_view: whether the sensor saw at least half of the footprint before the block fell.
    """

    epoch: int
    label: int
    size_m: float
    depth_m: float
    footprint_px: int
    data_share: float
    mean_m: float | None
    limit_m: float | None
    volume_m3: float
    measured_volume_m3: float
    in_view: bool
    seen: bool

    def to_dict(self) -> dict[str, Any]:
        """As JSON and CSV hold it."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class MeanTest:
    """The test of a block's mean: the noise's model and the level of detection of every pixel, (h, w), m."""

    model: VariogramModel
    level: NDArray[np.float32]
    gsd_m: float

    def limit_m(self, footprint: BoolArray, window: tuple[slice, slice]) -> float:
        """The level of detection of the mean over a footprint (n, m), which lies in `window` of the map."""
        level = self.level[window][footprint].astype(np.float64)
        share = variance_of_mean(self.model, footprint, self.gsd_m) / self.model.sill_m2 if self.model.sill_m2 > 0 else 0.0
        return float(np.sqrt(np.mean(level**2) * share))

    def mean_and_limit(
        self, change: NDArray[np.floating], footprint: BoolArray, window: tuple[slice, slice]
    ) -> tuple[float | None, float | None]:
        """Mean of the differences over the part of a footprint with data, m, and its limit; None where too little has data."""
        values = change[window]
        known = footprint & ~np.isnan(values)
        count = np.count_nonzero(known)
        if count < max(LEAST_PIXELS, LEAST_SHARE * np.count_nonzero(footprint)):
            return None, None
        return float(np.mean(values[known], dtype=np.float64)), self.limit_m(known, window)


def footprints(block: IntArray, true_change: NDArray[np.floating]) -> Iterator[tuple[int, tuple[slice, slice], BoolArray]]:
    """Label, window of the map and footprint in it of each block: the pixels of its label where the wall receded."""
    receded = np.where(true_change > 0, block, WALL)
    for label, window in enumerate(ndimage.find_objects(receded), start=1):
        if window is not None:
            yield label, window, receded[window] == label


def blocks_seen(
    epoch: int,
    change: NDArray[np.floating],
    block: IntArray,
    true_change: NDArray[np.floating],
    records: Sequence[dict[str, Any]],
    visible: BoolArray,
    test: MeanTest,
) -> list[BlockSeen]:
    """What the map `change` (h, w), m, of an epoch shows of each of its blocks.

    block, true_change: (h, w) labels and change of the wall as it really is, reference minus epoch, m; records: of blocks.json;
    visible: (h, w) where the sensor sees the untouched wall.
    """
    found = {label: (window, footprint) for label, window, footprint in footprints(block, true_change)}
    nowhere = (slice(0, 0), slice(0, 0)), np.zeros((0, 0), dtype=bool)
    area = test.gsd_m**2
    result = []
    for record in records:
        window, footprint = found.get(record["label"], nowhere)
        count = int(np.count_nonzero(footprint))
        differences = change[window][footprint]
        mean, limit = test.mean_and_limit(change, footprint, window)
        result.append(
            BlockSeen(
                epoch=epoch,
                label=record["label"],
                size_m=float((2 * max(record["volume_m3"], 0.0)) ** (1 / 3)),
                depth_m=float(np.mean(true_change[window][footprint], dtype=np.float64)) if count else 0.0,
                footprint_px=count,
                data_share=float(np.mean(~np.isnan(differences))) if count else 0.0,
                mean_m=mean,
                limit_m=limit,
                volume_m3=record["volume_m3"],
                measured_volume_m3=float(np.nansum(differences, dtype=np.float64) * area),
                in_view=bool(count) and record["volume_m3"] > 0 and float(np.mean(visible[window][footprint])) >= LEAST_SHARE,
                seen=mean is not None and limit is not None and mean > limit,
            )
        )
    return result


def false_alarms(
    stable: NDArray[np.floating], shapes: Sequence[BoolArray], test: MeanTest, random: KeyedRandom
) -> tuple[int, int]:
    """How many footprints, laid at random on the stable ground of one map (h, w), would be taken for blocks; and of how many."""
    generator = random.generator()
    alarms = trials = 0
    for shape in [shape for shape in shapes for _ in range(_PLACES)]:
        rows, columns = (full - part for full, part in zip(stable.shape, shape.shape, strict=True))
        if rows <= 0 or columns <= 0:
            continue
        row, column = int(generator.integers(rows)), int(generator.integers(columns))
        window = (slice(row, row + shape.shape[0]), slice(column, column + shape.shape[1]))
        mean, limit = test.mean_and_limit(stable, shape, window)
        if mean is not None and limit is not None:
            trials, alarms = trials + 1, alarms + (mean > limit)
    return alarms, trials


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's (1927) 95 % interval of a share."""
    if trials == 0:
        return 0.0, 1.0
    share, factor = successes / trials, Z_95**2 / trials
    middle = (share + factor / 2) / (1 + factor)
    half = Z_95 * np.sqrt(share * (1 - share) / trials + factor / (4 * trials)) / (1 + factor)
    return float(max(middle - half, 0.0)), float(min(middle + half, 1.0))
