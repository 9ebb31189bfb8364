"""The laser beam's cross section: sub-rays that share a pulse's energy, and how their echoes become the pulse's return.

Energy falls with the angle r from the axis as exp(-8 r^2 / D^2), D the full divergence where it has fallen to 1/e^2. A fraction u
of it lies within 8 r^2 / D^2 = -ln(1 - u). Rings of 6, 12, 18... sub-rays surround a central one; every sub-ray carries the same
energy, so ring j stands for the annulus between two such fractions, at its root-mean-square radius, and all radii are scaled so
that the second moments are the Gaussian's, D^2/16 about each axis. The share of the energy that a straight edge cuts off is then
right to 0.11 at worst with 19 sub-rays (root mean square 0.03), 0.22 with 7, 0.07 with 37. A hexagonal grid with Gaussian weights
does worse (0.15 with 19): an edge along the grid crosses many of its sub-rays at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Literal

import numpy as np

from scene.backend import dr, mi
from scene.mesh import FloatArray
from scene.upload import on_device

Mode = Literal["first", "strongest", "mean", "multiple"]
Ranging = Literal["pulse", "phase"]

SPEED_OF_LIGHT_M_S = 299_792_458.0
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_NOWHERE_M = 1e30
"""Range of a sub-ray without an echo: it sorts behind all others."""


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
        """Unit vectors of sub-rays by `number` (n,), 3 x (n,), about the axis and with the two unit vectors across it."""
        if self.sub_rays == 1:
            return axis
        divergence = dr.opaque(mi.Float64, self.divergence_rad)
        first, second = (divergence * vectors for vectors in across)
        x, y = (dr.gather(mi.Float64, on_device(mi.Float64, each), number) for each in unit_offsets(self.sub_rays).T)
        return dr.normalize(axis + x * first + y * second)

    def received(self, echoes: Sequence[Echo]) -> Echo:
        """The recorded return of every pulse, from the echoes of its sub-rays."""
        if len(echoes) == 1:
            return echoes[0]
        echoes = _with_misses_last(echoes)
        if self.modulation_wavelength_m is not None:
            return _in_phase(echoes, self.modulation_wavelength_m)
        if self.mode == "mean":
            return _merged(echoes, [echo.returned for echo in echoes])
        low, high = self._extent(echoes)
        found = _merged(echoes, [echo.returned & (echo.range_m >= low) & (echo.range_m <= high) for echo in echoes])
        return replace(found, returns=self._count(echoes)) if self.records_several else found

    @property
    def records_several(self) -> bool:
        """Whether there may be returns beside the one of `received`."""
        return self.mode == "multiple" and self.sub_rays > 1 and self.modulation_wavelength_m is None

    def _count(self, echoes: Sequence[Echo]) -> mi.UInt32:
        """(n,) how many returns every pulse has."""
        (high, energy), *others = self._sorted(echoes)
        gap, number = dr.opaque(mi.Float64, self.separation_m), dr.select(energy > 0, mi.UInt32(1), 0)
        for range_m, power in others:
            number += dr.select((range_m - high > gap) & (power > 0), mi.UInt32(1), 0)
            high = range_m
        return number

    def numbered(self, echoes: Sequence[Echo], number: mi.UInt32) -> Echo:
        """The return of a number, counted by range from 1; the strongest is the one of `received`."""
        echoes = _with_misses_last(echoes)
        (first, _), *others = self._sorted(echoes)
        gap, current = dr.opaque(mi.Float64, self.separation_m), mi.UInt32(1)
        low = high = previous = first
        for range_m, _ in others:
            starts = range_m - previous > gap
            current += dr.select(starts, mi.UInt32(1), 0)
            low = dr.select(starts & (current == number), range_m, low)
            high = dr.select(current == number, range_m, high)
            previous = range_m
        chosen = _merged(echoes, [echo.returned & (echo.range_m >= low) & (echo.range_m <= high) for echo in echoes])
        return replace(chosen, strongest=low == self._extent(echoes)[0])

    def _sorted(self, echoes: Sequence[Echo]) -> list[tuple[mi.Float64, mi.Float32]]:
        """(range, power) of the echoes by range, those that did not return last and without power."""
        return _by_range([(echo.range_m, dr.select(echo.returned, echo.power, mi.Float32(0))) for echo in echoes])

    def _extent(self, echoes: Sequence[Echo]) -> tuple[mi.Float64, mi.Float64]:
        """Nearest and farthest range of the recorded return's echoes.

        A return is a chain of echoes, sorted by range, each within the separation of the one before: no bins, so no bias.
        """
        zero, gap = mi.Float32(0), dr.opaque(mi.Float64, self.separation_m)
        (low, energy), *others = self._sorted(echoes)
        high, recorded, most = low, (low, low), energy
        for range_m, power in others:
            joins = range_m - high <= gap
            if self.mode == "first":
                high = dr.select(joins, range_m, high)  # once the chain has broken, all others are too far
                recorded = low, high
                continue
            low, high, energy = dr.select(joins, low, range_m), range_m, power + dr.select(joins, energy, zero)
            stronger = energy > most
            recorded = dr.select(stronger, low, recorded[0]), dr.select(stronger, high, recorded[1])
            most = dr.select(stronger, energy, most)
        return recorded


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


def _with_misses_last(echoes: Sequence[Echo]) -> list[Echo]:
    """The echoes, those that did not return beyond all others."""
    return [replace(echo, range_m=dr.select(echo.returned, echo.range_m, _NOWHERE_M)) for echo in echoes]


def _merged(echoes: Sequence[Echo], member: Sequence[mi.Bool]) -> Echo:
    """One return from the member echoes, weighted by power; the block is the strongest member's."""
    powers = [dr.select(belongs, echo.power, mi.Float32(0)) for echo, belongs in zip(echoes, member, strict=True)]
    total = sum(powers, mi.Float32(0))
    shares = [power / total for power in powers]
    nearest = reduce(_nearer, (echo.range_m for echo in echoes))
    reach = [dr.select(belongs, echo.range_m - nearest, 0.0) for echo, belongs in zip(echoes, member, strict=True)]
    strongest, block = powers[0], echoes[0].block
    for power, echo in zip(powers[1:], echoes[1:], strict=True):
        block = dr.select(power > strongest, echo.block, block)
        strongest = dr.select(power > strongest, power, strongest)
    return Echo(
        range_m=nearest + sum((mi.Float64(share) * far for share, far in zip(shares, reach, strict=True)), mi.Float64(0)),
        cos_incidence=_weighted(shares, [echo.cos_incidence for echo in echoes], member),
        albedo=_weighted(shares, [echo.albedo for echo in echoes], member),
        power=total / len(echoes),
        block=block,
        returned=total > 0,
    )


def _weighted(shares: Sequence[mi.Float32], values: Sequence[mi.Float32], member: Sequence[mi.Bool]) -> mi.Float32:
    terms = (dr.select(belongs, share * value, 0) for share, value, belongs in zip(shares, values, member, strict=True))
    return sum(terms, mi.Float32(0))


def _in_phase(echoes: Sequence[Echo], wavelength_m: float) -> Echo:
    """The return of a phase scanner: R = R_c + w / (4 pi) arg S, S = sum_k p_k exp(4 pi i (R_k - R_c) / w).

    Sub-rays add as phasors of the amplitude-modulated wave of length w; the magnitude is the recorded power. The cycle is the
    one nearest to the centroid R_c, which the scanner's longer waves give.
    """
    centroid = _merged(echoes, [echo.returned for echo in echoes])
    wave = dr.opaque(mi.Float64, 4 * np.pi / wavelength_m)
    real, imaginary = mi.Float64(0), mi.Float64(0)
    for echo in echoes:
        sine, cosine = dr.sincos(dr.select(echo.returned, wave * (echo.range_m - centroid.range_m), 0.0))
        power = mi.Float64(dr.select(echo.returned, echo.power, mi.Float32(0)))
        real, imaginary = real + power * cosine, imaginary + power * sine
    magnitude = dr.sqrt(dr.square(real) + dr.square(imaginary))
    quarter = dr.asin(imaginary / magnitude)  # dr.atan2 aborts in LLVM 15
    phase = dr.select(real >= 0, quarter, dr.select(imaginary < 0, -np.pi, np.pi) - quarter)
    return replace(centroid, range_m=centroid.range_m + phase / wave, power=mi.Float32(magnitude / len(echoes)))


def _nearer(first: mi.Float64, second: mi.Float64) -> mi.Float64:
    return dr.select(first < second, first, second)


def _by_range(echoes: list[tuple[mi.Float64, mi.Float32]]) -> list[tuple[mi.Float64, mi.Float32]]:
    """(range, power) pairs of every pulse, sorted by range with a network of comparisons."""
    echoes = list(echoes)
    for i, j in _network(len(echoes)):
        (range_i, power_i), (range_j, power_j) = echoes[i], echoes[j]
        swap = range_j < range_i
        echoes[i] = dr.select(swap, range_j, range_i), dr.select(swap, power_j, power_i)
        echoes[j] = dr.select(swap, range_i, range_j), dr.select(swap, power_i, power_j)
    return echoes


def _network(size: int) -> Iterator[tuple[int, int]]:
    """Batcher's odd-even merge sort for `size` elements (Knuth, TAOCP 3, 5.2.2, algorithm M): pairs (i, j), i < j, in order."""
    top = 1 << max((size - 1).bit_length() - 1, 0)
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while d > 0:
            yield from ((i, i + d) for i in range(size - d) if i & p == r)
            q, r, d = q // 2, p, q - p
        p //= 2
