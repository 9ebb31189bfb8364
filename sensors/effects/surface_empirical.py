"""An error of a cloud's points that is described over the surface, for a cloud whose cameras are not known."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.curve import Axis, Table, surface_on_host
from sensors.signal_chain.surface_places import Covariate, RecordedPoints, SurfacePlaces


class SurfaceEmpirical(Effect):
    """dn = c(x) or c(x, y), linear between values at even distances: how far points lie above the surface along its normal.
    Empirical, found by `scarpsim gap`; not in the shared catalogue.

    x, y: place along the wall, up it or out of its plane (m), slope against that plane (rad), roughness, convexity, or distance
    to the nearest edge (m).
    """

    name: Literal["surface_empirical"] = "surface_empirical"
    sensor = "stereo"
    stage = Stage.POINT
    shows_in = ShowsIn.MEAN
    catalogue = False
    empirical = True
    covariate: Covariate = Field("along", description="x")
    along: Axis = Field(Axis(), description="where the values stand on x")
    second: Covariate | None = Field(None, description="y, for a surface")
    across: Axis = Field(Axis(), description="where the rows of values stand on y")
    values_m: Table = Field(((0.0, 0.0),), description="c: rows along y, each from low to high of x [m]")

    @property
    def is_null(self) -> bool:
        return not any(map(any, self.values_m))

    def mean(self, at: SurfacePlaces) -> FloatArray:
        found = at.covariates
        return surface_on_host(
            found[self.covariate], found[self.second or self.covariate], self.along, self.across, self.values_m
        )

    def evaluate(self, state: RecordedPoints, random: KeyedRandom) -> RecordedPoints:
        return state.raised(self.mean(state.places))
