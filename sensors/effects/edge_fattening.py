"""Edge fattening: the foreground grows over the background at depth steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
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
        return FatteningTrials(disparity).fattened(self, cell_px, jump_px)


class FatteningTrials:
    """Edge fattening of one depth map, of which many radii, steps and windows are tried: what trials share is computed once."""

    def __init__(self, disparity: FloatArray, look_up: Callable[[FloatArray], FloatArray] = np.asarray) -> None:
        """Prepare the trials.

        Parameters
        ----------
        disparity : (rows, columns) array
            Disparities of the depth map, px, NaN where unmatched.
        look_up : callable
            Reads the cells of interest from an array with this shape; by default all cells.
        """
        self._disparity, self._look_up = disparity, look_up
        self._here = look_up(disparity)
        self._largest: dict[tuple[str, int], FloatArray] = {}

    def fattened(self, effect: EdgeFattening, cell_px: float, jump_px: float) -> FloatArray:
        """Return the disparities after edge fattening, px, in the cells of interest alone, in the form that `look_up` returns.

        effect: the edge fattening to try. cell_px, jump_px: as for `EdgeFattening.filtered`.
        """
        radius = int(effect.radius_px / cell_px + 1e-9)
        if effect.window == "rim":
            return self._with_rims(radius, max(effect.step_px, jump_px))
        largest = self._largest_in_window(effect.window, radius)
        return np.where(largest - self._here > effect.step_px, largest, self._here)

    def _with_rims(self, radius: int, step_px: float) -> FloatArray:
        """Disparities, where the near side of each depth step grows over the far side. An unmatched strip is background."""
        height, background = self._depth_steps
        rim = np.where(height > step_px, self._disparity, -np.inf)
        grown = self._look_up(cv2.dilate(rim, _disc(radius)))
        return np.where(grown - background > step_px, grown, self._here)

    @cached_property
    def _depth_steps(self) -> tuple[FloatArray, FloatArray]:
        """Height of each cell above its lowest neighbour, px; and disparity of the background in the cells of interest, px."""
        background = fill_gaps(self._disparity, np.inf)
        lowest = cv2.erode(np.where(np.isnan(background), np.inf, background), _CROSS)
        return self._disparity - lowest, self._look_up(background)

    def _largest_in_window(self, window: str, radius: int) -> FloatArray:
        """Largest disparity in a window about each cell of interest, px; cached. radius: of a disc or half a square, cells."""
        if (window, radius) not in self._largest:
            kernel = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8) if window == "square" else _disc(radius)
            matched = np.where(np.isnan(self._disparity), -np.inf, self._disparity)
            self._largest[window, radius] = self._look_up(cv2.dilate(matched, kernel))
        return self._largest[window, radius]


def _disc(radius: int) -> NDArray[np.uint8]:
    """Kernel of the cells within a radius, in cells, of the middle one."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return (x * x + y * y <= radius * radius).astype(np.uint8)
