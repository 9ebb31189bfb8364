"""Error of the range that no effect of the catalogue explains, as a curve or a surface."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.curve import Axis, Table, interpolate
from sensors.numerics.device import bounded
from sensors.signal_chain.pulses import Pulses

Covariate = Literal["range", "azimuth", "zenith", "incidence", "intensity", "time"]


class RangeEmpirical(Effect):
    """The range is wrong by dR = c(x) or c(x, y), a piecewise linear curve or surface.

    x and y are range (m), azimuth, zenith or incidence angle (rad), the logarithm of the received power, or the elapsed share
    of the scan's duration. Empirical: `scarpsim gap` adds it for a pattern without a known cause.
    """

    name: Literal["range_empirical"] = "range_empirical"
    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.MEAN
    catalogue = False
    empirical = True
    covariate: Covariate = Field("range", description="the quantity x on which the error depends")
    along: Axis = Field(Axis(), description="range of x that the values cover")
    second: Covariate | None = Field(None, description="a second quantity y, for a surface")
    across: Axis = Field(Axis(), description="range of y that the rows cover")
    values_m: Table = Field(((0.0, 0.0),), description="c: equally spaced rows along y, each from low to high x [m]")

    @property
    def is_null(self) -> bool:
        """Whether the effect is off: all values of its curve or surface are zero."""
        return not any(map(any, self.values_m))

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with the error, m, at each pulse's covariates added to its recorded range.

        state: the pulses of a scan before this effect. `random` is not used.
        """
        x, y = (self._of(state, each) for each in (self.covariate, self.second or self.covariate))
        return state.with_range_error(interpolate(x, y, self.along, self.across, self.values_m))

    @staticmethod
    def _of(pulses: Pulses, covariate: Covariate) -> mi.Float64:
        """Return a quantity (n,) by its name."""
        match covariate:
            case "range":
                return pulses.true_range
            case "azimuth":
                return pulses.azimuth
            case "zenith":
                return pulses.zenith
            case "incidence":
                return dr.acos(bounded(mi.Float64(pulses.cos_incidence), 0.0, 1.0))
            case "intensity":
                return dr.log(mi.Float64(pulses.power))
        return pulses.share
