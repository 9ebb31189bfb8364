"""An error of the disparity that no effect of the catalogue explains, as a polynomial of what it was seen to depend on."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.device import bounded, opaque
from sensors.effects.base import Effect, Stage
from sensors.effects.range_empirical import LARGEST
from sensors.matches import Matches


class DisparityEmpirical(Effect):
    """dd = sum_k c_k t^k, t = (x - centre) / scale, k from 1: empirical, found by `scarpsim gap`; not in the shared catalogue.

    x: column, row or distance from the centre of the left image (px), disparity or its fraction (px), or depth (m).
    """

    name: Literal["disparity_empirical"] = "disparity_empirical"
    sensor = "stereo"
    stage = Stage.MATCH
    order = 25
    covariate: Literal["image_x", "image_y", "radius", "disparity", "disparity_fraction", "depth"] = Field(
        "image_x", description="x"
    )
    centre: float = Field(0.0, description="of x, in its unit")
    scale: float = Field(1.0, gt=0, description="of x, in its unit")
    coefficients_px: tuple[float, ...] = Field((), max_length=6, description="of t, t^2, ... [px]")

    @property
    def is_null(self) -> bool:
        return not any(self.coefficients_px)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        centre, scale = opaque(self.centre, self.scale)
        t = bounded((self._covariate(state) - centre) / scale, -LARGEST, LARGEST)
        total = mi.Float64(0.0)
        for coefficient in reversed(opaque(*self.coefficients_px)):
            total = t * (coefficient + total)
        return replace(state, disparity=state.disparity + total)

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
