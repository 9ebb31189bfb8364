"""Decide which blocks a difference map shows, by comparing each block's mean change with its level of detection.

The level of detection of a pixel is what noise alone exceeds in 5 % of cases: the 95 % quantile of |difference| over the stable
pixels of all epochs, in square cells of the wall. It assumes no distribution.

A block of n pixels is detected if the mean D of its differences exceeds the level of detection of a mean,

    D > LoD = z s sqrt(V / C(0)),      z = 1.96,   s = level of detection of its pixels / z.

V is the variance of a mean over just these pixels and C(0) that of a single pixel. Both come from the variogram, which describes
the spatial correlation of the noise (Rolstad et al. 2009). s is the noise around the block (root mean square over it), as noise
varies over the wall (Hugonnet et al. 2022). A block with data on less than half of its pixels, or on fewer than four, is not
detected. As a check of the test, the same footprints are placed on stable ground, where they should be taken for blocks in 2.5 %
of cases; the observed rate is reported.

The share detected over the size x of the blocks in view follows P(x) = (1 - l) Phi((ln x - m) / w), fitted by maximum likelihood
(`detection_curve.py`). l is the share that no size makes visible, because the niche is hidden even where the block was not.
Blocks outside the sensor's view are counted separately: better precision does not help them, another station does.
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
"""Smallest number of pixels with data of a detected block."""
LEAST_SHARE = 0.5
"""Smallest share of a block's footprint with data."""
LEAST_CELL_PIXELS = 40
"""Smallest number of stable differences in a cell of the level of detection."""
_PLACES = 10
"""Number of random places on stable ground for each footprint."""


def level_of_detection(stable: NDArray[np.floating], cell_px: int) -> NDArray[np.float32]:
    """Compute the level of detection of each pixel: the difference that noise alone exceeds in 5 % of cases.

    It is the 95 % quantile of the absolute differences on stable ground in the same square cell of the map, over all epochs.

    Parameters
    ----------
    stable : (e, h, w) differences of e epochs, m; NaN outside stable ground and without data.
    cell_px : Side of a cell, pixels.

    Returns
    -------
    (h, w) level of detection, m. Cells with fewer than 40 differences get the median of the other cells. If all cells have
    fewer, it is NaN everywhere.
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
class BlockDetection:
    """One fallen block, and whether a sensor's difference map shows it.

    Attributes
    ----------
    epoch, label : Number of the epoch in which it fell, and its label in that epoch.
    size_m : (2 V)^(1/3) of the fallen volume V, m: the side of a cube that was half embedded in the rock.
    depth_m : True mean depth over its footprint, m.
    footprint_px : Number of pixels of the map on which its fall changed the wall (its footprint).
    data_share : Share of the footprint's pixels with data.
    mean_m : Mean difference over them, m; None with too little data.
    limit_m : Level of detection of that mean, m, which noise alone rarely exceeds; None with too little data.
    volume_m3, measured_volume_m3 : True volume, and sum of the differences over the footprint times the pixel area, m^3.
    in_view : Whether the sensor saw at least half of the footprint before the block fell.
    seen : Whether the block was detected: the mean exceeds its level of detection.
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
        """Return all that is known of one fallen block and its detection as a dictionary for JSON and CSV."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class BlockMeanTest:
    """Test whether the mean change over the footprint (changed pixels) of a fallen block exceeds what noise alone would give.

    Attributes
    ----------
    model : Variogram model of the noise.
    level : (h, w) level of detection of every pixel, m: the difference that noise alone exceeds in 5 % of cases.
    gsd_m : Pixel size, m.
    """

    model: VariogramModel
    level: NDArray[np.float32]
    gsd_m: float

    def limit_m(self, footprint: BoolArray, window: tuple[slice, slice]) -> float:
        """Return the mean change over a block's footprint that correlated noise alone rarely exceeds (its level of detection), m.

        Parameters
        ----------
        footprint : (n, m) mask of the block's pixels, true inside.
        window : The n rows and m columns of the whole map that the mask covers.
        """
        level = self.level[window][footprint].astype(np.float64)
        share = variance_of_mean(self.model, footprint, self.gsd_m) / self.model.sill_m2 if self.model.sill_m2 > 0 else 0.0
        return float(np.sqrt(np.mean(level**2) * share))

    def mean_and_limit(
        self, change: NDArray[np.floating], footprint: BoolArray, window: tuple[slice, slice]
    ) -> tuple[float | None, float | None]:
        """Compute the mean difference over a block's footprint, and the level of detection that it must exceed.

        Parameters
        ----------
        change : (h, w) difference map, m; NaN without data.
        footprint : (n, m) mask of the block's pixels, true inside.
        window : The n rows and m columns of the map that the mask covers.

        Returns
        -------
        Mean and level of detection over the pixels with data, m. None for both if fewer than half of the pixels, or fewer than
        four, have data.
        """
        values = change[window]
        known = footprint & ~np.isnan(values)
        count = np.count_nonzero(known)
        if count < max(LEAST_PIXELS, LEAST_SHARE * np.count_nonzero(footprint)):
            return None, None
        return float(np.mean(values[known], dtype=np.float64)), self.limit_m(known, window)


def footprints(block: IntArray, true_change: NDArray[np.floating]) -> Iterator[tuple[int, tuple[slice, slice], BoolArray]]:
    """Find the footprint of each fallen block in a true change map: the pixels with its label where the wall receded.

    Parameters
    ----------
    block : (h, w) block labels, 0 outside of blocks.
    true_change : (h, w) true change of the wall, reference minus epoch, m.

    Yields
    ------
    For each block its label, the rows and columns of the map around it, and the mask of its footprint in these rows and
    columns.
    """
    receded = np.where(true_change > 0, block, WALL)
    for label, window in enumerate(ndimage.find_objects(receded), start=1):
        if window is not None:
            yield label, window, receded[window] == label


def detect_blocks(
    epoch: int,
    change: NDArray[np.floating],
    block: IntArray,
    true_change: NDArray[np.floating],
    records: Sequence[dict[str, Any]],
    visible: BoolArray,
    test: BlockMeanTest,
) -> list[BlockDetection]:
    """Test for each block that fell in an epoch whether a sensor's difference map shows its fall.

    Parameters
    ----------
    epoch : Number of the epoch.
    change : (h, w) the sensor's difference map, m.
    block, true_change : (h, w) true block labels, and true change of the wall (reference minus epoch), m.
    records : One dictionary for each block with at least its label and its volume, m^3, as in blocks.json.
    visible : (h, w) true where the sensor sees the wall before the rockfall.
    test : The test whether a mean change exceeds the noise.

    Returns
    -------
    One result for each block, in the order of the records.
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
            BlockDetection(
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
    stable: NDArray[np.floating], shapes: Sequence[BoolArray], test: BlockMeanTest, random: KeyedRandom
) -> tuple[int, int]:
    """Place block footprints at random on stable ground, and count how many are falsely taken for fallen blocks.

    Parameters
    ----------
    stable : (h, w) differences of one map, m; NaN outside stable ground.
    shapes : Footprints of the blocks as masks; each is placed ten times.
    test : The test whether a mean change exceeds the noise.
    random : Source of the random places.

    Returns
    -------
    Number of false alarms, and number of placed footprints that had enough data to be tested.
    """
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
    """Return the 95 % confidence interval of a share, from the numbers of successes and trials (Wilson 1927)."""
    if trials == 0:
        return 0.0, 1.0
    share, factor = successes / trials, Z_95**2 / trials
    middle = (share + factor / 2) / (1 + factor)
    half = Z_95 * np.sqrt(share * (1 - share) / trials + factor / (4 * trials)) / (1 + factor)
    return float(max(middle - half, 0.0)), float(min(middle + half, 1.0))
