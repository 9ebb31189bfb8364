"""White matching noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.matches import Matches


class ParallaxNoise(Effect):
    """dd ~ N(0, sigma) per cell of the depth map: the pixel noise of the matching (thesis 3.4)."""

    name: Literal["parallax_noise"] = "parallax_noise"
    sensor = "stereo"
    stage = Stage.MATCH
    order = 40
    sigma_px: float = parameter("standard deviation of the disparity", unit="px", source="empirical", typical=0.3, ge=0, le=1000)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        noise = mi.Float64(random.normals(state.index).x)
        return replace(state, disparity=state.disparity + dr.opaque(mi.Float64, self.sigma_px) * noise)
