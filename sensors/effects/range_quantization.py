"""Quantisation: ranges are recorded in steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.signal_chain.pulses import PulseGeometry, Pulses


class RangeQuantization(Effect):
    """Ranges are rounded to the nearest multiple of `step`, after all other range effects.

    Where the range noise exceeds a third of the step, this adds the variance step^2 / 12 of a uniform error.
    """

    name: Literal["range_quantization"] = "range_quantization"
    means = "Ranges come in steps: the timer's resolution, or an export with too few digits."
    act = "Export with more decimals first. If the steps stay they are the instrument's: average several scans."
    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.VALUES
    planned = True
    order = 1
    step_m: float = parameter("step of the recorded range", unit="m", source="datasheets", typical=0.001, ge=0, le=100)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with each recorded range rounded to a multiple of the step, m.

        state: the pulses of a scan before this effect. `random` is not used.
        """
        step = dr.opaque(mi.Float64, self.step_m)
        return replace(state, range_m=step * dr.round(state.range_m / step))

    def variance(self, at: PulseGeometry) -> FloatArray:
        """Return the variance of a rounding error, step^2 / 12, m2, the same for all pulses (n,).

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.full(len(at), self.step_m**2 / 12)
