"""Time walk: range error that depends on the received power."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import parameter
from sensors.effects.laser import RangeEffect
from sensors.numerics.functions import Functions
from sensors.signal_chain.pulses import PulseGeometry, Pulses


class RangeIntensityBias(RangeEffect):
    """The range error depends on the received power (time walk).

    dR = k ln(I / I_0), with the coefficient k, the received power I, and I_0 a given power or the median of all pulses that
    return. A detector with a fixed threshold notices a weak echo later: its k is negative. If a correction overdoes it, k is
    positive. The median belongs to one scan: give I_0 if several scans, or parts of a scan, have to agree. Pulses that other
    effects remove afterwards count in the median.
    """

    name: Literal["range_intensity_bias"] = "range_intensity_bias"
    means = "Dark rock is measured at another range than bright rock: the detector's time walk is not fully corrected."
    act = "Do not take steps at borders of colour or wetness for movement; correct ranges by intensity, or scan in like weather."
    looks_at = "whole"
    needs = ("power",)
    coefficient_m: float = parameter(
        "range error per e-fold of the received power", unit="m", source="pulse scanners, empirical", typical=0.005, ge=-10, le=10
    )
    reference_power: float | None = parameter(
        "received power I_0 at which the error is zero; none: the scan's median",
        unit="1, relative to albedo 1 at 100 m",
        source="empirical",
        null=None,
        gt=0,
        le=1e12,
    )

    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the range error (n,), m, in proportion to the logarithm of the received power over the reference power.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """
        return p.coefficient_m * m.log(at.power / p.reference_power)

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with the range error, m, added; the reference power is by default the median of all returns.

        state: the pulses of a scan before this effect. `random` is not used.
        """
        if self.reference_power:
            return super().evaluate(state, random)
        state = state.evaluated()
        return self._about(np.array(state.power)[np.array(state.returned)]).evaluate(state, random)

    def mean(self, at: PulseGeometry) -> FloatArray:
        """Return the range error (n,), m, that the received power causes.

        If the effect has no reference power, the pulses' median power is taken.

        at: geometry of n pulses, as NumPy arrays.
        """
        return super().mean(at) if self.reference_power else self._about(at.power).mean(at)

    def _about(self, power: FloatArray) -> RangeIntensityBias:
        """Return the same effect with the median of some powers as reference power."""
        return self.model_copy(update={"reference_power": (float(np.median(power)) if power.size else 0.0) or 1.0})
