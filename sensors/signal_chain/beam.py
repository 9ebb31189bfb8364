"""The laser beam's cross section: sub-rays that share a pulse's energy, and how their echoes become the pulse's return.

Energy falls with the angle r from the axis as exp(-8 r^2 / D^2), D the full divergence where it has fallen to 1/e^2. A fraction u
of it lies within 8 r^2 / D^2 = -ln(1 - u). Rings of 6, 12, 18... sub-rays surround a central one; every sub-ray carries the same
energy, so ring j stands for the annulus between two such fractions, at its root-mean-square radius, and all radii are scaled so
that the second moments are the Gaussian's, D^2/16 about each axis. The share of the energy that a straight edge cuts off is then
right to 0.11 at worst with 19 sub-rays (root mean square 0.03), 0.22 with 7, 0.07 with 37. A hexagonal grid with Gaussian weights
does worse (0.15 with 19): an edge along the grid crosses many of its sub-rays at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.geometry.mesh import FloatArray
from scene.ray_casting.upload import on_device

Mode = Literal["first", "strongest", "mean", "multiple"]
Ranging = Literal["pulse", "phase"]

SPEED_OF_LIGHT_M_S = 299_792_458.0
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_NOWHERE_M = 1e30
"""Beyond every echo."""


@dataclass(frozen=True)
class Echo:
    """What one ray of every pulse, or a whole pulse, brings back; device arrays (n,). Names as in `Pulses`; range in m.

    returns: how many the pulse has; strongest: whether this is the strongest of them; None where only one is recorded.
    """

    range_m: mi.Float64
    cos_incidence: mi.Float32
    albedo: mi.Float32
    power: mi.Float32
    block: mi.Int32
    returned: mi.Bool
    returns: mi.UInt32 | None = None
    strongest: mi.Bool | None = None

    def at(self, index: mi.UInt32) -> Echo:
        """The echoes at the given places."""
        return Echo(**{name: dr.gather(type(value), value, index) for name, value in self._known()})

    @staticmethod
    def joined(parts: Sequence[Echo]) -> Echo:
        """The echoes of all parts, one part after the other."""
        return Echo(**{name: dr.concat([getattr(part, name) for part in parts]) for name, _ in parts[0]._known()})

    def _known(self) -> list[tuple[str, Any]]:
        return [(name, value) for name, value in vars(self).items() if value is not None]


@dataclass(frozen=True)
class SubRays:
    """The echoes (n times `many`,) of all sub-rays of n pulses in memory, pulse by pulse."""

    echoes: Echo
    many: int

    def over(self, step: Callable[..., tuple[Any, ...]], *state: Any) -> tuple[Any, ...]:
        """The state after `step(echo, *state)` for one sub-ray of every pulse after another: a loop in the compiled kernel."""
        many = dr.opaque(mi.UInt32, self.many)
        first = many * dr.arange(mi.UInt32, dr.width(self.echoes.range_m) // self.many)

        def next_one(number: mi.UInt32, *state: Any) -> tuple[Any, ...]:
            return number + 1, *step(self.echoes.at(first + number), *state)

        _, *after = dr.while_loop((first * 0, *state), lambda number, *_: number < many, next_one)
        return tuple(after)


@dataclass(frozen=True)
class Beam:
    """A beam and its receiver: a pencil unless a footprint effect widens it.

    divergence_rad: full angle, 1/e^2; sub_rays: 1 + 3 m (m + 1) for m rings; mode: which return of several is recorded,
    multiple: the strongest and beside it all others; separation_m: echoes nearer to each other than this run into one return
    (c tau / 2); modulation_wavelength_m: of a phase scanner's finest measuring wave, None for pulses.
    """

    divergence_rad: float = 0.0
    sub_rays: int = 1
    mode: Mode = "mean"
    separation_m: float = 0.0
    modulation_wavelength_m: float | None = None

    def sub_ray(self, axis: mi.Array3f64, across: Sequence[mi.Array3f64], number: mi.UInt32) -> mi.Array3f64:
        """Unit vectors of sub-rays by `number` (n,), 3 x (n,), about the axis and with the two unit vectors across it.

        The three stand upright on each other, so that weights of unit length make unit vectors.
        """
        if self.sub_rays == 1:
            return axis
        aside = self.divergence_rad * unit_offsets(self.sub_rays)
        weights = np.column_stack([np.ones(len(aside)), aside]) / np.sqrt(1 + np.sum(aside**2, axis=1, keepdims=True))
        along, first, second = dr.gather(mi.Array3f64, on_device(mi.Float64, weights), number)
        return along * axis + first * across[0] + second * across[1]

    def received(self, rays: SubRays) -> Echo:
        """The recorded return of every pulse, from the echoes of its sub-rays."""
        if rays.many == 1:
            return rays.echoes
        if self.modulation_wavelength_m is not None:
            return _in_phase(rays, self.modulation_wavelength_m)
        if self.mode == "mean":
            return _merged(rays, lambda echo: echo.returned)
        count, first, strongest = self._separated(rays, mi.UInt32(1))
        found = _merged(rays, (first if self.mode == "first" else strongest).holds)
        return replace(found, returns=count) if self.records_several else found

    @property
    def records_several(self) -> bool:
        """Whether there may be returns beside the one of `received`."""
        return self.mode == "multiple" and self.sub_rays > 1 and self.modulation_wavelength_m is None

    def numbered(self, rays: SubRays, number: mi.UInt32) -> Echo:
        """The return of a number, counted by range from 1; the strongest is the one of `received`."""
        _, chosen, strongest = self._separated(rays, number)
        return replace(_merged(rays, chosen.holds), strongest=chosen.low == strongest.low)

    def _separated(self, rays: SubRays, number: mi.UInt32) -> tuple[mi.UInt32, _Span, _Span]:
        """How many returns every pulse has, the reach of the one of a number, counted by range from 1, and of the strongest.

        A return is a chain of echoes, each within the separation of another: no bins, so no bias.
        """
        gap = dr.opaque(mi.Float64, self.separation_m)

        def farther(echo: Echo, high: mi.Float64) -> tuple[mi.Float64]:
            joins = echo.returned & (echo.range_m > high) & (echo.range_m - high <= gap)
            return (dr.select(joins, echo.range_m, high),)

        def chain(high: mi.Float64, _: mi.Bool) -> tuple[mi.Float64, mi.Bool]:
            (reached,) = rays.over(farther, high)
            return reached, reached > high

        def following(
            count: mi.UInt32, chosen: _Span, strongest: _Span, most: mi.Float32, last: mi.Float64, _: mi.Bool
        ) -> tuple[Any, ...]:
            (low,) = rays.over(
                lambda echo, low: (dr.select(echo.returned & (echo.range_m > last) & (echo.range_m < low), echo.range_m, low),),
                mi.Float64(_NOWHERE_M),
            )
            there = low < _NOWHERE_M
            high, _ = dr.while_loop((mi.Float64(low), mi.Bool(there)), lambda _, grows: grows, chain)
            own = _Span(low, high)
            (energy,) = rays.over(lambda echo, sum_: (sum_ + dr.select(own.holds(echo), echo.power, 0),), mi.Float32(0))
            count += dr.select(there, mi.UInt32(1), 0)
            stronger = there & (energy > most)
            chosen = own.where(there & (count == number), chosen)
            return count, chosen, own.where(stronger, strongest), dr.select(stronger, energy, most), high, there

        nowhere = _Span(mi.Float64(_NOWHERE_M), mi.Float64(_NOWHERE_M))
        start = mi.UInt32(0), nowhere, nowhere, mi.Float32(-1), mi.Float64(-1), mi.Bool(True)
        count, chosen, strongest, *_ = dr.while_loop(start, lambda *state: state[-1], following)
        return count, chosen, strongest


@dataclass
class _Span:
    """From the nearest to the farthest echo of a return, m. Not frozen: Dr.Jit's loops put their own variables in."""

    low: mi.Float64
    high: mi.Float64

    def holds(self, echo: Echo) -> mi.Bool:
        return echo.returned & (echo.range_m >= self.low) & (echo.range_m <= self.high)

    def where(self, condition: mi.Bool, other: _Span) -> _Span:
        """This span where the condition holds, else the other."""
        return _Span(dr.select(condition, self.low, other.low), dr.select(condition, self.high, other.high))


def unit_offsets(sub_rays: int) -> FloatArray:
    """(k, 2) offsets of the sub-rays from the axis for D = 1 (see the module's text); ring j is turned by j golden angles."""
    rings = round((np.sqrt(12 * sub_rays - 3) - 3) / 6)
    bounds = np.cumsum([0, 1, *(6 * ring for ring in range(1, rings + 1))]) / sub_rays
    offsets = [np.zeros((1, 2))]
    for ring in range(1, rings + 1):
        angle = ring * _GOLDEN_ANGLE + 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        offsets.append(_ring_radius(bounds[ring], bounds[ring + 1]) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    stacked = np.concatenate(offsets)
    return stacked * np.sqrt(1 / 8 / np.mean(np.sum(stacked**2, axis=1)))


def _ring_radius(inner: float, outer: float) -> float:
    """Root-mean-square radius, in units of D, of the energy between two fractions of it.

    The energy with t = 8 r^2 / D^2 beyond t is exp(-t), and the integral of t exp(-t) from t on is (t + 1) exp(-t).
    """

    def tail(fraction: float) -> float:
        return 0.0 if fraction == 1 else (1 - np.log1p(-fraction)) * (1 - fraction)

    return float(np.sqrt((tail(inner) - tail(outer)) / (outer - inner) / 8))


def _merged(rays: SubRays, belongs: Callable[[Echo], mi.Bool]) -> Echo:
    """One return from the echoes that belong to it, weighted by power; the block is the strongest one's."""

    def gathered(echo: Echo, total: Any, nearest: Any, strongest: Any, block: Any) -> tuple[Any, ...]:
        power = dr.select(belongs(echo), echo.power, mi.Float32(0))
        nearer, stronger = echo.returned & (echo.range_m < nearest), power > strongest
        return (
            total + power,
            dr.select(nearer, echo.range_m, nearest),
            dr.select(stronger, power, strongest),
            dr.select(stronger, echo.block, block),
        )

    start = mi.Float32(0), mi.Float64(_NOWHERE_M), mi.Float32(-1), mi.Int32(0)
    total, nearest, _, block = rays.over(gathered, *start)

    def weighted(echo: Echo, reach: Any, cos_incidence: Any, albedo: Any) -> tuple[Any, ...]:
        member = belongs(echo)
        share = dr.select(member, echo.power, mi.Float32(0)) / total
        return (
            reach + mi.Float64(share) * dr.select(member, echo.range_m - nearest, 0.0),
            cos_incidence + dr.select(member, share * echo.cos_incidence, 0),
            albedo + dr.select(member, share * echo.albedo, 0),
        )

    reach, cos_incidence, albedo = rays.over(weighted, mi.Float64(0), mi.Float32(0), mi.Float32(0))
    power = total * dr.opaque(mi.Float32, 1 / rays.many)
    return Echo(nearest + reach, cos_incidence, albedo, power, block, returned=total > 0)


def _in_phase(rays: SubRays, wavelength_m: float) -> Echo:
    """The return of a phase scanner: R = R_c + w / (4 pi) arg S, S = sum_k p_k exp(4 pi i (R_k - R_c) / w).

    Sub-rays add as phasors of the amplitude-modulated wave of length w; the magnitude is the recorded power. The cycle is the
    one nearest to the centroid R_c, which the scanner's longer waves give.
    """
    centroid = _merged(rays, lambda echo: echo.returned)
    wave = dr.opaque(mi.Float64, 4 * np.pi / wavelength_m)

    def added(echo: Echo, real: mi.Float64, imaginary: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        sine, cosine = dr.sincos(dr.select(echo.returned, wave * (echo.range_m - centroid.range_m), 0.0))
        power = mi.Float64(dr.select(echo.returned, echo.power, mi.Float32(0)))
        return real + power * cosine, imaginary + power * sine

    real, imaginary = rays.over(added, mi.Float64(0), mi.Float64(0))
    magnitude = dr.sqrt(dr.square(real) + dr.square(imaginary))
    quarter = dr.asin(imaginary / magnitude)  # dr.atan2 aborts in LLVM 15
    phase = dr.select(real >= 0, quarter, dr.select(imaginary < 0, -np.pi, np.pi) - quarter)
    power = mi.Float32(magnitude * dr.opaque(mi.Float64, 1 / rays.many))
    return replace(centroid, range_m=centroid.range_m + phase / wave, power=power)
