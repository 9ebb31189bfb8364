"""Range error in proportion to the range."""

from __future__ import annotations

from typing import Literal

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from sensors.effects.base import Effect, Stage, parameter
from sensors.pulses import Pulses


class RangeScale(Effect):
    """dR = scale R: the instrument's scale, air temperature and pressure (about +1 ppm/K, -0.28 ppm/hPa; Lichti 2007, A1)."""

    name: Literal["range_scale"] = "range_scale"
    sensor = "tls"
    stage = Stage.RANGE
    scale_ppm: float = parameter(
        "recorded over true range, less one", unit="ppm", source="Lichti 2007, A1", typical=20.0, ge=-1e5, le=1e5
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        return state.with_range_error(dr.opaque(mi.Float64, self.scale_ppm * 1e-6) * state.true_range)
