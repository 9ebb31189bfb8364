"""The three kinds that most effects of a laser scanner are of, each an equation written once for the device and for the host.

An equation is given `at`, what it looks at (`PulseGeometry`), `m`, the functions of such arrays, and `p`, the effect's own
parameters as numbers of the same kind.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from scene.common.backend import mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage
from sensors.numerics.functions import DEVICE, HOST, Functions, OnDevice
from sensors.signal_chain.pulses import PulseGeometry, Pulses


class AimEffect(Effect):
    """The beam leaves in another direction than is recorded.

    An error d of a recorded angle makes it leave by -d, and the range that is recorded is that of where it went:
    dR = -d dR/dangle, to first order.
    """

    sensor = "tls"
    stage = Stage.AIM
    shows_in = ShowsIn.MEAN

    @abstractmethod
    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Recorded minus true azimuth and zenith, rad."""

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        azimuth, zenith = self.angles(state.geometry(), DEVICE, OnDevice(self))
        return state.with_angle_error(azimuth, zenith)

    def mean(self, at: PulseGeometry) -> FloatArray:
        azimuth, zenith = self.angles(at, HOST, self)
        return np.asarray(-azimuth * at.by_azimuth - zenith * at.by_zenith)


class RangeEffect(Effect):
    """The recorded range is off."""

    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.MEAN

    @abstractmethod
    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Recorded minus true range, m."""

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        return state.with_range_error(self.error(state.geometry(), DEVICE, OnDevice(self)))

    def mean(self, at: PulseGeometry) -> FloatArray:
        return np.broadcast_to(self.error(at, HOST, self), len(at)).astype(np.float64)


class RangeSpread(Effect):
    """The recorded range scatters: white noise, a number of its own for each pulse."""

    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.SPREAD
    planned = True

    @abstractmethod
    def sigma(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Standard deviation of the range, m."""

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        sigma = self.sigma(state.geometry(), DEVICE, OnDevice(self))
        return state.with_range_error(sigma * mi.Float64(state.normals(random).x))

    def variance(self, at: PulseGeometry) -> FloatArray:
        return np.broadcast_to(np.square(self.sigma(at, HOST, self)), len(at)).astype(np.float64)
