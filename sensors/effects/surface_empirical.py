"""Error of a cloud's points described over the surface, for a cloud whose cameras are unknown."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.curve import Axis, Table, interpolate_on_host
from sensors.signal_chain.surface_places import Covariate, RecordedPoints, SurfacePlaces


class SurfaceEmpirical(Effect):
    """Points lie above the surface, along its normal, by dn = c(x) or c(x, y), a piecewise linear curve or surface (m).

    x and y are the position along the wall, up it or out of its plane (m), the slope against that plane (rad), the roughness
    and convexity of the rock around the point (m), or the distance to the nearest edge (m). Empirical: `scarpsim gap` adds it
    for a pattern without a known cause.
    """

    name: Literal["surface_empirical"] = "surface_empirical"
    sensor = "stereo"
    stage = Stage.POINT
    shows_in = ShowsIn.MEAN
    catalogue = False
    empirical = True
    covariate: Covariate = Field("along", description="the quantity x on which the error depends")
    along: Axis = Field(Axis(), description="range of x that the values cover")
    second: Covariate | None = Field(None, description="a second quantity y, for a surface")
    across: Axis = Field(Axis(), description="range of y that the rows cover")
    values_m: Table = Field(((0.0, 0.0),), description="c: equally spaced rows along y, each from low to high x [m]")

    @property
    def is_null(self) -> bool:
        """Whether the effect is off: all values of its curve or surface are zero."""
        return not any(map(any, self.values_m))

    def mean(self, at: SurfacePlaces) -> FloatArray:
        """Return the height error (n,) of the points along the surface's normal, m, by their covariates.

        at: n places on the surface.
        """
        found = at.covariates
        return interpolate_on_host(
            found[self.covariate], found[self.second or self.covariate], self.along, self.across, self.values_m
        )

    def evaluate(self, state: RecordedPoints, random: KeyedRandom) -> RecordedPoints:
        """Return the points moved along the surface's normal by the error, m, at each point's covariates.

        state: the recorded points before this effect. `random` is not used.
        """
        return state.with_height_error(self.mean(state.places))
