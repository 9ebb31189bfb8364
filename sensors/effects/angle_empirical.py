"""Error of a recorded angle that no effect of the catalogue explains, as a curve of an angle."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from scene.common.keyed_random import KeyedRandom
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.curve import Axis, Table, interpolate
from sensors.signal_chain.pulses import Pulses

Angle = Literal["azimuth", "zenith"]


class AngleEmpirical(Effect):
    """An angle is recorded wrong by d(angle) = c(x), a piecewise linear curve of an angle.

    Empirical: `scarpsim gap` adds it for a pattern without a known cause. As with every error of an angle, the beam leaves by
    this much on the opposite side of the recorded direction.
    """

    name: Literal["angle_empirical"] = "angle_empirical"
    sensor = "tls"
    stage = Stage.AIM
    shows_in = ShowsIn.MEAN
    catalogue = False
    empirical = True
    angle: Angle = Field("azimuth", description="the recorded angle that has the error")
    covariate: Angle = Field("azimuth", description="the angle x on which the error depends [rad]")
    along: Axis = Field(Axis(), description="range of x that the values cover")
    values_rad: Table = Field(
        ((0.0, 0.0),), description="c, recorded minus true: one row of equally spaced values, from low to high x [rad]"
    )

    @field_validator("values_rad")
    @classmethod
    def _one_row(cls, values: Table) -> Table:
        if len(values) != 1:
            raise ValueError(f"holds {len(values)} rows; an angle's error is a curve: one row")
        return values

    @property
    def is_null(self) -> bool:
        """Whether the effect is off: all values of its curve are zero."""
        return not any(map(any, self.values_rad))

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with an error of azimuth or zenith, rad: the curve's value at each pulse's covariate.

        state: the pulses of a scan before this effect. `random` is not used.
        """
        x = state.azimuth if self.covariate == "azimuth" else state.zenith
        error = interpolate(x, x, self.along, Axis(), self.values_rad)
        return state.with_angle_error(**{self.angle: error})
