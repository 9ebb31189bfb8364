"""Half-occluded strips that a matcher fills."""

from __future__ import annotations

from typing import Literal

from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.matches import Matches, bridged


class OcclusionFill(Effect):
    """d = min(d_before, d_after): an unmatched strip of a row, at most `reach` wide, is taken for background.

    d_before and d_after are the disparities at the strip's two ends; the smaller is farther away (Hirschmueller 2008, 2.5.3).
    Strips that reach a row's end stay empty.
    """

    name: Literal["occlusion_fill"] = "occlusion_fill"
    sensor = "stereo"
    stage = Stage.FILL
    reach_px: float = parameter("widest strip that is filled", unit="px", source="Hirschmueller 2008", typical=80.0, ge=0, le=1e5)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        return state.with_raster(bridged(state.raster(), self.reach_px / state.reduction))
