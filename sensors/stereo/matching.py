"""Match a rectified pair of pictures with OpenCV's semi-global block matching, tile by tile.

Disparities here are in cells of the pictures: column in the left one minus column in the right one.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from scene.common.config import Config
from scene.common.errors import InputError
from sensors.stereo.rectified import Disparity, Picture
from sensors.stereo.refinement import RefinementConfig

MODES = {"sgbm": cv2.STEREO_SGBM_MODE_SGBM, "hh": cv2.STEREO_SGBM_MODE_HH, "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY}
"""OpenCV's name of each mode."""
SUBPIXELS = 16
"""OpenCV's disparities are integers, in sixteenths of a pixel."""
MOST_DISPARITIES = 2048
"""Largest search range, cells."""
SPECKLE_STEP_PX = 1.0
"""Neighbouring cells whose disparities differ by more than this belong to different regions."""


class MatchingConfig(Config):
    """Settings of OpenCV's semi-global matching (a variant of Hirschmueller 2008), which really matches rendered photographs.

    One pixel (px) is one of the pictures that are matched, which are as large as the depth map, not one of the full frame.
    """

    block_size_px: int = Field(5, ge=1, le=21, description="side of the window whose costs are summed, odd [px]")
    p1: float = Field(8.0, ge=0, description="penalty of a disparity step of one, per pixel of the window")
    p2: float = Field(32.0, gt=0, description="penalty of a larger step, per pixel of the window; more than p1")
    uniqueness_percent: int = Field(5, ge=0, le=100, description="by how much the best match must beat the second best [%]")
    mode: Literal["sgbm", "hh", "3way"] = Field("sgbm", description="paths of the aggregation: 5 (sgbm), 8 (hh), 3 (3way)")
    left_right_tolerance_px: int = Field(1, ge=1, description="largest disagreement of the two directions of matching [px]")
    speckle_px: int = Field(60, ge=0, description="smooth regions of at most this many pixels are dropped")
    depth_margin_m: float = Field(1.0, ge=0, description="how far the search goes before and behind the visible surface [m]")
    tile_px: int = Field(1024, ge=64, description="side of the tiles that are matched one by one [px]")
    overlap_px: int = Field(64, ge=0, le=1024, description="how far a tile looks beyond its own pixels [px]")
    refinement: RefinementConfig | None = Field(
        RefinementConfig(), description="least-squares matching after the semi-global one; none: no refinement"
    )

    @field_validator("block_size_px")
    @classmethod
    def _odd(cls, size: int) -> int:
        if size % 2 == 0:
            raise ValueError("must be odd")
        return size

    @field_validator("p2")
    @classmethod
    def _larger(cls, p2: float, info: Any) -> float:
        if not p2 > info.data.get("p1", 0.0):
            raise ValueError("must be larger than p1")
        return p2


@dataclass(frozen=True)
class SearchRange:
    """The range of disparities that a matcher searches: `count` values (a multiple of 16) from `least` on, cells."""

    least: int
    count: int

    @classmethod
    def between(cls, smallest: float, largest: float) -> SearchRange:
        """Return a range of disparities for the matcher to search that contains all from `smallest` to `largest`.

        Both are in cells of the depth map, fractions allowed. The range has at least one cell more on either side, and its
        count is rounded up to a multiple of 16. Raises InputError if it is too wide to be matched.
        """
        least = int(np.floor(smallest)) - 1
        count = 16 * int(np.ceil((largest + 2 - least) / 16))
        if count > MOST_DISPARITIES:
            raise InputError(
                f"the surface spans {count} disparities (offsets between the two images, px)",
                where="matching",
                allowed=f"at most {MOST_DISPARITIES}",
                remedy="choose a depth_map with larger pixels, or a smaller depth_margin_m",
            )
        return cls(least, count)


def match(left: Picture, right: Picture, search: SearchRange, config: MatchingConfig) -> Disparity:
    """Match two rectified pictures by semi-global matching: find the disparity of each cell of the left one.

    The left-right check is OpenCV's: from the same costs, the best left cell of every right cell must agree. Tiles run in as
    many threads as OpenCV uses; the result does not depend on their number.

    Parameters
    ----------
    left, right : (h, w) and (h, any) arrays
        Grey values, NaN outside the images.
    search : SearchRange
        The disparities that are searched.
    config : MatchingConfig
        The matcher.

    Returns
    -------
    (h, w) array
        Disparities of the left picture's cells, in cells (steps of 1/16), NaN without a match.
    """
    canvas_left, canvas_right = _aligned(left, right, search)
    raw = np.full(left.shape, -SUBPIXELS, dtype=np.int16)

    def fill(tile: tuple[slice, slice]) -> None:
        raw[tile] = _matched_tile(canvas_left, canvas_right, tile, search, config)

    with ThreadPoolExecutor(max(1, cv2.getNumThreads())) as pool:
        for _ in pool.map(fill, _tiles(left.shape, config.tile_px)):
            pass
    return np.where((raw < 0) | np.isnan(left), np.float32(np.nan), raw.astype(np.float32) / SUBPIXELS + search.least)


def without_speckles(disparity: Disparity, speckle_px: int) -> Disparity:
    """Remove small isolated regions from the disparities of a depth map, such as stray matches in the sky; return the others.

    disparity: (h, w), in cells of the depth map, NaN without a match. speckle_px: a connected region of at most this many
    cells, in which neighbours differ by at most one cell of disparity, becomes NaN.
    """
    known = ~np.isnan(disparity)
    least = np.float32(np.floor(disparity[known].min())) if known.any() else np.float32(0)
    steps = np.where(known, np.rint((disparity - least) * SUBPIXELS), -SUBPIXELS).astype(np.int16)
    cv2.filterSpeckles(steps, -SUBPIXELS, speckle_px, SPECKLE_STEP_PX * SUBPIXELS)
    return np.where(steps < 0, np.float32(np.nan), disparity)


def _aligned(left: Picture, right: Picture, search: SearchRange) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Copy both pictures in 8 bits to canvases of the same size, so that disparity `search.least` becomes 0.

    No left cell lacks room. Left cell j is at column j + count of its canvas; the right cell that matches it at the least
    disparity is at the same column.
    """
    rows, columns = left.shape
    canvases = np.zeros((2, rows, columns + search.count), dtype=np.uint8)
    canvases[0, :, search.count :] = _grey(left)
    shift = search.count + search.least  # column of right cell 0 on its canvas
    start, stop = max(0, -shift), min(right.shape[1], canvases.shape[2] - shift)
    if stop > start:
        canvases[1, :, start + shift : stop + shift] = _grey(right[:, start:stop])
    return canvases[0], canvases[1]


def _grey(picture: Picture) -> NDArray[np.uint8]:
    """Convert a picture to 8 bits; unknown pixels become 0."""
    return np.clip(np.rint(np.nan_to_num(picture)), 0, 255).astype(np.uint8)


def _tiles(shape: tuple[int, int], side: int) -> list[tuple[slice, slice]]:
    """Divide a picture into tiles."""
    starts = [range(0, length, side) for length in shape]
    return [
        (slice(row, min(row + side, shape[0])), slice(column, min(column + side, shape[1])))
        for row in starts[0]
        for column in starts[1]
    ]


def _matched_tile(
    left: NDArray[np.uint8], right: NDArray[np.uint8], tile: tuple[slice, slice], search: SearchRange, config: MatchingConfig
) -> NDArray[np.int16]:
    """Match one tile together with its surroundings; return its raw disparities, with columns as in the left picture."""
    rows, columns = tile
    top, first = max(0, rows.start - config.overlap_px), max(0, columns.start - config.overlap_px)
    around = (
        slice(top, min(left.shape[0], rows.stop + config.overlap_px)),
        slice(first, min(left.shape[1], columns.stop + search.count + config.overlap_px)),
    )
    raw = _matcher(search.count, config).compute(np.ascontiguousarray(left[around]), np.ascontiguousarray(right[around]))
    inner = columns.start - first + search.count
    return raw[rows.start - top : rows.stop - top, inner : inner + columns.stop - columns.start]


def _matcher(count: int, config: MatchingConfig) -> Any:
    """Make OpenCV's matcher for `count` disparities from 0 on."""
    area = config.block_size_px**2
    return cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=count,
        blockSize=config.block_size_px,
        P1=round(config.p1 * area),
        P2=round(config.p2 * area),
        disp12MaxDiff=config.left_right_tolerance_px,
        preFilterCap=63,
        uniquenessRatio=config.uniqueness_percent,
        mode=MODES[config.mode],
    )
