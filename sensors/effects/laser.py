"""Define the three base classes of most laser scanner effects, in which each equation is written once for device and host.

An equation gets `at`, the geometry (`PulseGeometry`); `m`, the functions for such arrays; and `p`, the effect's own parameters
as numbers of the same kind.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from scene.common.backend import mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.functions import DEVICE, HOST, DeviceParameters, Functions
from sensors.signal_chain.pulses import PulseGeometry, Pulses


class AimEffect(Effect):
    """An effect by which the beam leaves in another direction than is recorded.

    With an error d of a recorded angle the beam leaves by -d, and the recorded range is that of where it went: dR = -d
    dR/dangle, to first order.
    """

    sensor = "tls"
    stage = Stage.AIM
    shows_in = ShowsIn.MEAN

    @abstractmethod
    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return recorded minus true azimuth and zenith, (n,) each, rad; a number if it is the same for all pulses.

        at: geometry of n pulses; m: `HOST` for NumPy or `DEVICE` for Dr.Jit arrays; p: object with the effect's parameters.
        """

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Add the angle errors to the pulses: recorded minus true azimuth and zenith, rad."""
        azimuth, zenith = self.angles(state.geometry(), DEVICE, DeviceParameters(self))
        return state.with_angle_error(azimuth, zenith)

    def mean(self, at: PulseGeometry) -> FloatArray:
        """Return the range error (n,), m, that the angle errors cause on an inclined surface, to first order."""
        azimuth, zenith = self.angles(at, HOST, self)
        return np.asarray(-azimuth * at.by_azimuth - zenith * at.by_zenith)


class RangeEffect(Effect):
    """An effect that changes the recorded range systematically."""

    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.MEAN

    @abstractmethod
    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return recorded minus true range (n,), m; a number if it is the same for all pulses.

        at: geometry of n pulses; m: `HOST` for NumPy or `DEVICE` for Dr.Jit arrays; p: object with the effect's parameters.
        """

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Add the systematic error, m, to each recorded range."""
        return state.with_range_error(self.error(state.geometry(), DEVICE, DeviceParameters(self)))

    def mean(self, at: PulseGeometry) -> FloatArray:
        """Return the systematic range error (n,), recorded minus true, m."""
        return np.broadcast_to(self.error(at, HOST, self), len(at)).astype(np.float64)


class RangeSpread(Effect):
    """An effect that adds white noise to the recorded range, independent for each pulse."""

    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.SPREAD
    planned = True

    @abstractmethod
    def sigma(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the standard deviation of the range (n,), m; a number if it is the same for all pulses.

        at: geometry of n pulses; m: `HOST` for NumPy or `DEVICE` for Dr.Jit arrays; p: object with the effect's parameters.
        """

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Add normal noise, m, to each recorded range, independently for each pulse."""
        sigma = self.sigma(state.geometry(), DEVICE, DeviceParameters(self))
        return state.with_range_error(sigma * mi.Float64(state.normals(random).x))

    def variance(self, at: PulseGeometry) -> FloatArray:
        """Return the variance (n,) of the range noise, m2."""
        return np.broadcast_to(np.square(self.sigma(at, HOST, self)), len(at)).astype(np.float64)
