"""An error of the disparity that no effect of the catalogue explains, as a curve of what it was seen to depend on."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.curve import curve
from sensors.effects.base import Effect, Stage
from sensors.matches import Matches


class DisparityEmpirical(Effect):
    """dd = c(x), c linear between values at even distances from low to high: empirical, found by `scarpsim gap`; not in the
    shared catalogue.

    x: column, row or distance from the centre of the left image (px), disparity or its fraction (px), or depth (m).
    """

    name: Literal["disparity_empirical"] = "disparity_empirical"
    sensor = "stereo"
    stage = Stage.MATCH
    order = 25
    covariate: Literal["image_x", "image_y", "radius", "disparity", "disparity_fraction", "depth"] = Field(
        "image_x", description="x"
    )
    low: float = Field(0.0, description="x of the first value, in its unit; held below")
    high: float = Field(1.0, description="x of the last value, in its unit; held above")
    period: float = Field(0.0, ge=0, description="of x, which then counts modulo it; 0: none")
    values_px: tuple[float, ...] = Field((0.0, 0.0), min_length=2, max_length=1025, description="c from low to high [px]")

    @property
    def is_null(self) -> bool:
        return not any(self.values_px)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        error = curve(self._covariate(state), self.low, self.high, self.values_px, self.period)
        return replace(state, disparity=state.disparity + error)

    def _covariate(self, matches: Matches) -> mi.Float64:
        match self.covariate:
            case "image_x":
                return matches.u
            case "image_y":
                return matches.v
            case "radius":
                return dr.sqrt(dr.square(matches.u - matches.width / 2) + dr.square(matches.v - matches.height / 2))
            case "disparity":
                return matches.disparity
            case "disparity_fraction":
                return matches.disparity - dr.floor(matches.disparity)
        return matches.true_depth
