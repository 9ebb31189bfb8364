"""Rain, snow or dust in the air."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.numerics.device import opaque
from sensors.signal_chain.pulses import PulseGeometry, Pulses


class Precipitation(Effect):
    """Rain, snow or dust absorbs echoes, and some drops return one themselves.

    A return at range R is lost with probability 1 - exp(-2 beta R). The share `early_share` of the lost ones returns early,
    from a drop. The drop's range r has the density exp(-2 beta r), normalised between the instrument's minimum range and R. An
    early return keeps the pulse's range errors and its power, because a drop's brightness is not modelled. It belongs to no
    block. Pulses that hit nothing do not return from drops.
    """

    name: Literal["precipitation"] = "precipitation"
    means = "Rain, snow or dust returns echoes of its own and swallows others."
    act = "Scan again in clear air; of what is there, keep last echoes and drop lone points in front of the wall."
    sensor = "tls"
    stage = Stage.RETURN
    shows_in = ShowsIn.RETURNS
    rate_per_m: float = parameter("extinction coefficient beta", unit="1/m", source="rain, dust, snow", typical=1e-4, ge=0, le=10)
    early_share: float = parameter(
        "share of the lost returns that a drop gives back", unit="1", source="empirical", null=None, default=0.1, ge=0, le=1
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses after rain: returns are lost at random, more at long range, and some come from a drop instead.

        state: the pulses of a scan before this effect. random: source of random numbers.
        """
        double_rate, early_share = opaque(2 * self.rate_per_m, self.early_share)
        nearest: mi.Float64 = state.minimum_range
        true_range: mi.Float64 = state.true_range
        chance = mi.Array3f64(*(mi.Float64(number) for number in list(state.uniforms(random))[:3]))
        lost = state.returned & (chance.x >= dr.exp(-double_rate * true_range))
        early = lost & (chance.y < early_share)
        within = 1 - dr.exp(-double_rate * (true_range - nearest))
        drop = nearest - dr.log(1 - chance.z * within) / double_rate
        return replace(
            state,
            range_m=dr.select(early, state.range_m + (drop - true_range), state.range_m),
            block=dr.select(early, WALL, state.block),
            returned=state.returned & (~lost | early),
        )

    def kept(self, at: PulseGeometry) -> FloatArray:
        """Return the probability (n,) that rain, snow or dust lets the rock's own echo through.

        It is exp(-2 beta R), with the extinction coefficient beta and the range R.

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.exp(-2 * self.rate_per_m * np.asarray(at.range_m, dtype=np.float64))
