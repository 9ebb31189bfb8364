"""Edge fattening: the foreground grows over the background at depth steps."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scene.geometry.mesh import FloatArray
from sensors.effects.base import parameter
from sensors.effects.raster_effect import RasterEffect
from sensors.signal_chain.matches import fill_gaps

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=np.uint8)


class EdgeFattening(RasterEffect):
    """At depth steps the foreground grows over the background by the radius r: outlines become larger, niches smaller.

    d'(p) = max of d(q) over |q - p| <= r: cell p gets the largest disparity of the cells q within r that lie on the near side
    of a depth step. A depth step is where neighbouring cells differ by more than one pixel of the matched image (the
    discontinuities of semi-global matching, Hirschmueller 2008); for a matcher that follows steeper slopes, increase `step_px`.
    Smaller slopes do not change. Half-occluded cells within r get the foreground's disparity too, since the outlines in both
    images grow alike and pass the left-right check. r is rounded down to whole cells.

    That is `window: rim`. A matcher that compares windows without regard to steps takes the nearest rock in its window, also on
    a steep slope: with `window: disc` or `square`, d'(p) is the largest d(q) in a disc of radius r or a square of half-width r
    about p, where it exceeds d(p) by more than `step_px`.
    """

    name: Literal["edge_fattening"] = "edge_fattening"
    means = "At depth steps the near rock grows over the far rock: the matching window straddles the edge."
    act = "Use a smaller matching window, and mask a window's width at depth edges before comparing."
    order = 10
    radius_px: float = parameter("reach beyond the outline", unit="px", source="Hirschmueller 2008", typical=8.0, ge=0, le=1000)

    step_px: float = Field(
        1.0,
        gt=0,
        le=1000,
        description="neighbours that differ by more are a depth step; at least one pixel of the matched image for a rim [px]",
    )
    window: Literal["rim", "disc", "square"] = Field("rim", description="what grows: rims of depth steps, or all in a window")

    def filtered(self, disparity: FloatArray, cell_px: float, jump_px: float) -> FloatArray:
        """Return the disparities, px, with the near side of each depth step grown by the radius, in whole cells.

        disparity: (rows, columns) of the depth map, px, NaN without a match. cell_px: px of the full-resolution frame for each
        cell. jump_px: smallest difference of neighbours that is a depth step, px.
        """
        radius = int(self.radius_px / cell_px + 1e-9)
        if self.window == "rim":
            return fattened(disparity, radius, max(self.step_px, jump_px))
        return largest_in_window(disparity, radius, self.step_px, square=self.window == "square")


def fattened(disparity: FloatArray, radius: int, step_px: float) -> FloatArray:
    """Let the near side of each depth step grow over the far side, as in a matcher's depth map, and return the new disparities.

    Parameters
    ----------
    disparity : (rows, columns) array
        Disparities, px, NaN where unmatched.
    radius : int
        How far the foreground grows, cells of the depth map.
    step_px : float
        Neighbours that differ by more than this are a depth step, px. An unmatched strip counts as background.
    """
    background = fill_gaps(disparity, np.inf)
    lowest = cv2.erode(np.where(np.isnan(background), np.inf, background), _CROSS)
    rim = np.where(disparity - lowest > step_px, disparity, -np.inf)
    grown = cv2.dilate(rim, _disc(radius))
    return np.where(grown - background > step_px, grown, disparity)


def largest_in_window(disparity: FloatArray, radius: int, step_px: float, *, square: bool) -> FloatArray:
    """Give each cell the largest disparity in a window about it, as in a matcher's depth map, if that is clearly larger.

    Parameters
    ----------
    disparity : (rows, columns) array
        Disparities, px, NaN where unmatched; such cells stay unmatched.
    radius : int
        Radius of a disc, or half-width of a square, cells of the depth map.
    step_px : float
        Cells of which the largest disparity in the window exceeds their own by no more than this do not change, px.
    square : bool
        Whether the window is a square.
    """
    window = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8) if square else _disc(radius)
    largest = cv2.dilate(np.where(np.isnan(disparity), -np.inf, disparity), window)
    return np.where(largest - disparity > step_px, largest, disparity)


def _disc(radius: int) -> NDArray[np.uint8]:
    """Kernel of the cells within a radius, in cells, of the middle one."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return (x * x + y * y <= radius * radius).astype(np.uint8)
