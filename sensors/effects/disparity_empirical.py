"""An error of the disparity that no effect of the catalogue explains, as a curve of what it was seen to depend on."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.curve import Axis, Table, surface
from sensors.signal_chain.matches import Matches

Covariate = Literal["image_x", "image_y", "radius", "disparity", "disparity_fraction", "depth"]


class DisparityEmpirical(Effect):
    """dd = c(x) or c(x, y), linear between values at even distances: empirical, found by `scarpsim gap`; not in the shared
    catalogue.

    x, y: column, row or distance from the centre of the left image (px), disparity or its fraction (px), or depth (m).
    """

    name: Literal["disparity_empirical"] = "disparity_empirical"
    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.MEAN
    catalogue = False
    empirical = True
    order = 25
    covariate: Covariate = Field("image_x", description="x")
    along: Axis = Field(Axis(), description="where the values stand on x")
    second: Covariate | None = Field(None, description="y, for a surface")
    across: Axis = Field(Axis(), description="where the rows of values stand on y")
    values_px: Table = Field(((0.0, 0.0),), description="c: rows along y, each from low to high of x [px]")

    @property
    def is_null(self) -> bool:
        return not any(map(any, self.values_px))

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        x, y = (self._of(state, each) for each in (self.covariate, self.second or self.covariate))
        return replace(state, disparity=state.disparity + surface(x, y, self.along, self.across, self.values_px))

    @staticmethod
    def _of(matches: Matches, covariate: Covariate) -> mi.Float64:
        match covariate:
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
