"""Random pointing error of the beam."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scene.common.backend import mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter
from sensors.numerics.device import opaque
from sensors.signal_chain.pulses import PulseGeometry, Pulses


class AngleNoise(Effect):
    """The beam leaves in another direction than is recorded, with white noise in azimuth and zenith.

    aim = recorded - n, with a normal error n ~ N(0, sigma) that is drawn for each angle of each pulse.
    """

    name: Literal["angle_noise"] = "angle_noise"
    means = (
        "The beam's directions scatter more than the model says: seen on slanting rock, where a direction's error becomes depth."
    )
    act = "Simulate and plan with the value found; set the tripod firmly, out of the wind, and check that it does not turn."
    told_by = "rock that is inclined otherwise at the same range"
    sensor = "tls"
    stage = Stage.AIM
    shows_in = ShowsIn.SPREAD
    planned = True
    azimuth_sigma_rad: float = parameter(
        "standard deviation in azimuth", unit="rad", source="datasheets", typical=5e-5, ge=0, le=0.1
    )
    zenith_sigma_rad: float = parameter(
        "standard deviation in zenith", unit="rad", source="datasheets", typical=5e-5, ge=0, le=0.1
    )

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with normal errors of azimuth and zenith, rad, drawn independently for each angle of each pulse.

        state: the pulses of a scan before this effect. random: source of random numbers.
        """
        noise = state.normals(random)
        azimuth, zenith = opaque(self.azimuth_sigma_rad, self.zenith_sigma_rad)
        return state.with_angle_error(azimuth * mi.Float64(noise.x), zenith * mi.Float64(noise.y))

    def variance(self, at: PulseGeometry) -> FloatArray:
        """Return the variance (n,) that the angle errors add to the range, m2, to first order: large on inclined rock.

        at: geometry of n pulses, as NumPy arrays.
        """
        by_azimuth, by_zenith = self.azimuth_sigma_rad * at.by_azimuth, self.zenith_sigma_rad * at.by_zenith
        return np.asarray(by_azimuth**2 + by_zenith**2)
