"""Error of the disparity that no effect of the catalogue explains, as a curve or a surface."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.curve import Axis, Table, interpolate
from sensors.signal_chain.matches import Matches

Covariate = Literal["image_x", "image_y", "radius", "disparity", "disparity_fraction", "depth"]


class DisparityEmpirical(Effect):
    """The disparity is wrong by dd = c(x) or c(x, y), a piecewise linear curve or surface.

    x and y are column, row or distance from the centre of the left image (px), the disparity or its fraction (px), or the depth
    (m). Empirical: `scarpsim gap` adds it for a pattern without a known cause.
    """

    name: Literal["disparity_empirical"] = "disparity_empirical"
    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.MEAN
    catalogue = False
    empirical = True
    order = 25
    covariate: Covariate = Field("image_x", description="the quantity x on which the error depends")
    along: Axis = Field(Axis(), description="range of x that the values cover")
    second: Covariate | None = Field(None, description="a second quantity y, for a surface")
    across: Axis = Field(Axis(), description="range of y that the rows cover")
    values_px: Table = Field(((0.0, 0.0),), description="c: equally spaced rows along y, each from low to high x [px]")

    @property
    def is_null(self) -> bool:
        """Whether the effect is off: all values of its curve or surface are zero."""
        return not any(map(any, self.values_px))

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with c(x, y), px, added to each disparity: the curve or surface `values_px`, interpolated.

        state: the matched cells of the depth map before this effect. `random` is not used.
        """
        x, y = (self._of(state, each) for each in (self.covariate, self.second or self.covariate))
        return replace(state, disparity=state.disparity + interpolate(x, y, self.along, self.across, self.values_px))

    @staticmethod
    def _of(matches: Matches, covariate: Covariate) -> mi.Float64:
        """Return a covariate x or y (n,) of the matches by its name, px; depth in m."""
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
