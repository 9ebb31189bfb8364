"""Echoes too weak to be detected."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.signal_chain.pulses import PulseGeometry, Pulses


class DetectionLimit(Effect):
    """An echo below a minimum power gives no return.

    The power is rho cos i (100 m / R)^2, with albedo rho, incidence angle i and range R. It is relative to that of albedo 1 at
    100 m and normal incidence (lidar range equation).
    """

    name: Literal["detection_limit"] = "detection_limit"
    means = "Echoes below a power are lost: dark, wet, distant or slanting rock leaves holes."
    act = "Move nearer, wait for dry rock, or lower the pulse rate; do not read a hole as missing rock."
    sensor = "tls"
    stage = Stage.RETURN
    shows_in = ShowsIn.RETURNS
    planned = True
    minimum_power: float = parameter(
        "smallest received power that is detected",
        unit="1, relative to albedo 1 at 100 m",
        source="range equation",
        typical=0.1,
        ge=0,
        le=1e12,
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses without the returns whose received power is below the minimum.

        state: the pulses of a scan before this effect. `random` is not used.
        """
        return replace(state, returned=state.returned & (state.power >= dr.opaque(mi.Float32, self.minimum_power)))

    def kept(self, at: PulseGeometry) -> FloatArray:
        """Return the probability (n,) that each return is detected: 1 for a power of at least the minimum, 0 below it.

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.asarray(at.power >= self.minimum_power, dtype=np.float64)
