"""Foreground that grows over the background at depth steps."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from pydantic import Field

from scene.geometry.mesh import FloatArray
from sensors.effects.base import parameter
from sensors.effects.raster_effect import RasterEffect
from sensors.signal_chain.matches import bridged

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=np.uint8)


class EdgeFattening(RasterEffect):
    """d(p) = max of d(q) over |q - p| <= r, q on the near side of a depth step: outlines grow by r, niches' rims shrink.

    A depth step is where neighbouring cells differ by more than one pixel of the image that is matched: semi-global matching's
    discontinuities (Hirschmueller 2008); a matcher that follows steeper slopes has a higher `step_px`. Slopes below that stay as
    they are. Half-occluded cells within r get the foreground's disparity too, since both images' outlines grow alike and pass the
    left-right check. r is used in whole cells, rounded down.
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
        description="neighbours that differ by more are a depth step, at least a pixel of the match [px]",
    )

    def filtered(self, disparity: FloatArray, cell_px: float, jump_px: float) -> FloatArray:
        return fattened(disparity, int(self.radius_px / cell_px + 1e-9), max(self.step_px, jump_px))


def fattened(disparity: FloatArray, radius: int, step_px: float) -> FloatArray:
    """(rows, columns) disparities, px, NaN where unmatched, with the near side of each step grown by `radius` cells.

    step_px: neighbours that differ by more are a step; across an unmatched strip, the strip counts as background.
    """
    background = bridged(disparity, np.inf)
    lowest = cv2.erode(np.where(np.isnan(background), np.inf, background), _CROSS)
    rim = np.where(disparity - lowest > step_px, disparity, -np.inf)
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    grown = cv2.dilate(rim, (x * x + y * y <= radius * radius).astype(np.uint8))
    return np.where(grown - background > step_px, grown, disparity)
