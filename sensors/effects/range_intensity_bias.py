"""Time walk: range error that depends on the received power."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.device import opaque
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeIntensityBias(Effect):
    """dR = k ln(I / I_0), I the received power and I_0 the median of all pulses that return, or a given one.

    A weaker echo crosses a fixed threshold later, so that k is negative there. The median belongs to one scan: give I_0 where
    scans or parts of a scan are to agree. Pulses that are lost only at the return stage still count in the median.
    """

    name: Literal["range_intensity_bias"] = "range_intensity_bias"
    sensor = "tls"
    stage = Stage.RANGE
    coefficient_m: float = parameter(
        "range error per e-fold of the received power", unit="m", source="pulse scanners, empirical", typical=0.005, ge=-10, le=10
    )
    reference_power: float | None = parameter(
        "received power without an error; none: the scan's median",
        unit="1, relative to albedo 1 at 100 m",
        source="empirical",
        null=None,
        gt=0,
        le=1e12,
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        state = state if self.reference_power else state.evaluated()
        coefficient, reference = opaque(self.coefficient_m, self.reference_power or _median(state))
        return state.with_range_error(coefficient * dr.log(mi.Float64(state.power) / reference))


def _median(pulses: Pulses) -> float:
    powers = np.array(pulses.power)[np.array(pulses.returned)]
    return float(np.median(powers)) if powers.size else 1.0
