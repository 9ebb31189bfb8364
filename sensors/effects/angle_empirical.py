"""An error of a recorded angle that no effect of the catalogue explains, as a curve of an angle."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from scene.common.keyed_random import KeyedRandom
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.curve import Axis, Table, surface
from sensors.signal_chain.pulses import Pulses

Angle = Literal["azimuth", "zenith"]


class AngleEmpirical(Effect):
    """d(angle) = c(x), linear between values at even distances: empirical, found by `scarpsim gap`; not in the shared catalogue.

    The beam leaves by as much on the other side of where it is recorded, as with every error of an angle.
    """

    name: Literal["angle_empirical"] = "angle_empirical"
    sensor = "tls"
    stage = Stage.AIM
    shows_in = ShowsIn.MEAN
    catalogue = False
    empirical = True
    angle: Angle = Field("azimuth", description="the recorded angle that is off")
    covariate: Angle = Field("azimuth", description="x [rad]")
    along: Axis = Field(Axis(), description="where the values stand on x")
    values_rad: Table = Field(((0.0, 0.0),), description="c, recorded minus true: one row, from low to high of x [rad]")

    @field_validator("values_rad")
    @classmethod
    def _one_row(cls, values: Table) -> Table:
        if len(values) != 1:
            raise ValueError(f"holds {len(values)} rows; an angle's error is a curve: one row")
        return values

    @property
    def is_null(self) -> bool:
        return not any(map(any, self.values_rad))

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        x = state.azimuth if self.covariate == "azimuth" else state.zenith
        error = surface(x, x, self.along, Axis(), self.values_rad)
        return state.with_angle_error(**{self.angle: error})
