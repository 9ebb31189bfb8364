"""Half-occluded strips that a matcher fills."""

from __future__ import annotations

from typing import Literal

from scene.geometry.mesh import FloatArray
from sensors.effects.base import Stage, parameter
from sensors.effects.raster_effect import RasterEffect
from sensors.signal_chain.matches import fill_gaps


class OcclusionFill(RasterEffect):
    """The matcher fills half-occluded strips of a row with the background's disparity.

    Half-occluded means that one camera alone sees the rock, so that there is no match. d' = min(d_before, d_after) is the
    disparity in an unmatched strip at most `reach` wide. The smaller of the disparities at its two ends is farther away
    (Hirschmueller 2008, 2.5.3). Strips that reach the end of a row stay empty.
    """

    name: Literal["occlusion_fill"] = "occlusion_fill"
    means = "Strips that one camera alone sees were filled with invented depths."
    act = "Switch hole filling off, or use a left-right check, and mask the strips beside edges."
    stage = Stage.FILL
    reach_px: float = parameter("widest strip that is filled", unit="px", source="Hirschmueller 2008", typical=80.0, ge=0, le=1e5)

    def filtered(self, disparity: FloatArray, cell_px: float, jump_px: float) -> FloatArray:
        """Return the disparities, px, with narrow strips without a match filled from the background.

        disparity: (rows, columns) of the depth map, px, NaN without a match. cell_px: px of the full-resolution frame for each
        cell. jump_px: smallest difference of neighbours that is a depth step, px; not used.
        """
        return fill_gaps(disparity, self.reach_px / cell_px)
