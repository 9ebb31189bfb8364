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
    """Base class of errors of a scanner's angles: the beam leaves in another direction than is recorded.

    If a recorded angle is too large by d, the beam leaves at an angle that is smaller by d. The scanner records the range of
    the rock that this beam meets. On inclined rock the range is therefore wrong by dR = -d dR/dangle, to first order, where
    dR/dangle is the change of the range with the angle (m/rad).
    """

    sensor = "tls"
    stage = Stage.AIM
    shows_in = ShowsIn.MEAN

    @abstractmethod
    def angles(self, at: PulseGeometry, m: Functions, p: Any) -> tuple[Any, Any]:
        """Return the errors of azimuth and zenith, recorded minus true, rad: arrays (n,), or a number valid for all pulses.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with the errors of azimuth and zenith, recorded minus true, rad.

        state: the pulses of a scan before this effect. `random` is not used.
        """
        azimuth, zenith = self.angles(state.geometry(), DEVICE, DeviceParameters(self))
        return state.with_angle_error(azimuth, zenith)

    def mean(self, at: PulseGeometry) -> FloatArray:
        """Return the range error (n,), m, that the angle errors cause on an inclined surface, to first order.

        at: geometry of n pulses, as NumPy arrays.
        """
        azimuth, zenith = self.angles(at, HOST, self)
        return np.asarray(-azimuth * at.by_azimuth - zenith * at.by_zenith)


class RangeEffect(Effect):
    """Base class of systematic errors of a scanner's range. A subclass gives the equation of the error."""

    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.MEAN

    @abstractmethod
    def error(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return recorded minus true range (n,), m; a number if it is the same for all pulses.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with the systematic error, m, added to each recorded range.

        state: the pulses of a scan before this effect. `random` is not used.
        """
        return state.with_range_error(self.error(state.geometry(), DEVICE, DeviceParameters(self)))

    def mean(self, at: PulseGeometry) -> FloatArray:
        """Return the systematic range error (n,), recorded minus true, m.

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.broadcast_to(self.error(at, HOST, self), len(at)).astype(np.float64)


class RangeSpread(Effect):
    """Base class of white noise of a scanner's range, independent for each pulse. A subclass gives its standard deviation."""

    sensor = "tls"
    stage = Stage.RANGE
    shows_in = ShowsIn.SPREAD
    planned = True

    @abstractmethod
    def sigma(self, at: PulseGeometry, m: Functions, p: Any) -> Any:
        """Return the standard deviation of the range (n,), m; a number if it is the same for all pulses.

        at: geometry of n pulses. m: elementary functions (sine, logarithm and so on) for its arrays, `HOST` for NumPy or
        `DEVICE` for Dr.Jit. p: object with the effect's parameters as numbers.
        """

    def evaluate(self, state: Pulses, random: KeyedRandom) -> Pulses:
        """Return the pulses with normal noise, m, added to each recorded range, independently for each pulse.

        state: the pulses of a scan before this effect. random: source of random numbers.
        """
        sigma = self.sigma(state.geometry(), DEVICE, DeviceParameters(self))
        return state.with_range_error(sigma * mi.Float64(state.normals(random).x))

    def variance(self, at: PulseGeometry) -> FloatArray:
        """Return the variance (n,) of the range noise, m2.

        at: geometry of n pulses, as NumPy arrays.
        """
        return np.broadcast_to(np.square(self.sigma(at, HOST, self)), len(at)).astype(np.float64)
