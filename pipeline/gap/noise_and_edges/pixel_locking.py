"""Pixel locking by the measured disparities alone: they crowd around the matched image's pixels, whatever the noise.

If d' = x + A sin(2 pi x / n + phase) and x is spread over many pixels, the mean of exp(2 pi i d' / n) is -J1(2 pi A / n)
exp(-i phase) (Jacobi-Anger), also where x holds noise that would average the sine away in the residuals. The k-th multiple of the
angle gives |Jk(2 pi k A / n)|; what blurs the disparities by s after the locking takes exp(-2 (pi k s / n)^2) of it.

The rectification in which the disparities were found is not part of a measurement. Another one has another principal distance and
may be turned about the base by an angle w, so that d' = s d / (1 + y tan w), d counted from that of a point at
infinity, y the tangent of a row's angle to the axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import j1, jv

from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray

_REDUCTIONS = (1.0, 2.0, 4.0, 8.0)
_SCALE_UNKNOWN, _TILT_UNKNOWN = 0.03, 0.1
"""By how much the principal distance of the matcher's rectification may be another, and its turn about the base, rad."""
_SHAPE_BAND = 0.18
"""Frequencies about that of whole pixels, as a share of it, at which what crowds is the wall's shape."""
_BINS_A_CYCLE, _STEPS_A_CYCLE = 8, 4
_MOST_BINS = 4096
_LARGEST_AMPLITUDE = 0.6
"""Amplitude in matched pixels."""
_PROFILE_HALF_WIDTH = 0.06
"""Matched pixels about the best amplitude over which its spread is taken: twice that of one that noise nearly hides."""
_NOISE_UNCERTAINTY, _LEAST_NOISE_SHARE = 0.1, 0.01
"""Share by which the noise may be another than predicted and measured; of the measured variance, what is noise at least."""
_MULTIPLES = np.arange(1, 5)
_FOLDING, _LARGE_AMPLITUDE, _HARMONIC_MISFIT = 1 / (2 * np.pi), 0.3, 0.02
_MOST_POINTS = 60_000


@dataclass(frozen=True)
class Locking:
    """amplitude_px, std_px; period_px: n; phase_rad of the disparities that were given; tilt_rad: turn about the base of
    the rectification in which they were found; gain in log-likelihood."""

    amplitude_px: float
    std_px: float
    period_px: float
    phase_rad: float
    tilt_rad: float
    gain: float


@dataclass(frozen=True)
class NoiseBounds:
    """Standard deviations, px, of the noise that a model predicts, and of what was measured about the surface as known, noise and
    locking together. Of small amplitudes the first multiple alone shows, whose size the noise changes as they do."""

    predicted: float
    measured: float

    def in_pixels(self, frequency: float) -> NoiseBounds:
        """In matched pixels, of so many a px."""
        return NoiseBounds(self.predicted * frequency, self.measured * frequency)

    def blurs(self, amplitude: FloatArray) -> tuple[FloatArray, FloatArray]:
        """From and to which the noise may be beside each amplitude, px."""
        left = np.sqrt(np.maximum(self.measured**2 - amplitude**2 / 2, _LEAST_NOISE_SHARE * self.measured**2))
        return (1 - _NOISE_UNCERTAINTY) * np.minimum(left, self.predicted), (1 + _NOISE_UNCERTAINTY) * np.maximum(
            left, self.predicted
        )


def find_locking(
    disparity: FloatArray,
    reference: FloatArray,
    tangent: FloatArray | float = 0.0,
    infinity: FloatArray | float = 0.0,
    spread: NoiseBounds | None = None,
) -> Locking | None:
    """The locking that measured disparities (n,), px, show, if any: n |R|^2 is exponential where there is none (Rayleigh).

    reference: (n,) disparities of the surface as known; what crowds there too, by more than chance, is its shape; tangent: (n,)
    of the angle between a point's rectified row and the axis; infinity: disparity of a point at infinity; spread: None where the
    noise may be anything.
    """
    thin = slice(None, None, max(len(disparity) // _MOST_POINTS, 1))
    far = np.broadcast_to(infinity, disparity.shape)[thin]
    some, known, rows = disparity[thin] - far, reference[thin] - far, np.broadcast_to(tangent, disparity.shape)[thin]
    count, reach = len(some), float(np.ptp(np.quantile(some, [0.02, 0.98])))
    best: tuple[float, float, float, float] | None = None
    for reduction in _REDUCTIONS:
        if reach < thresholds().locking.fewest_cycles * reduction:
            continue
        whole = 1 / reduction
        frequency, tilt, _, tries = _strongest_crowding(some, rows, whole, _SCALE_UNKNOWN)
        _, _, crowded, tries_beside = _strongest_crowding(known, rows, whole, _SHAPE_BAND)
        shape = np.sqrt(max(crowded**2 - np.log(tries_beside) / count, 0.0))
        frequency, tilt = _refine_frequency(some, rows, frequency, tilt)
        crowds = _crowding(some, rows, frequency, tilt)
        gain = count * max(crowds - thresholds().locking.crowding_ratio * shape, 0.0) ** 2
        if best is None or gain > best[0]:
            best = gain, frequency, tilt, tries
    if best is None:
        return None
    gain, frequency, tilt, tries = best
    by_chance = min(1.0, len(_REDUCTIONS) * tries * float(np.exp(-gain)))
    if by_chance > thresholds().locking.significance:
        return None
    pixels = frequency * (some / (1 + np.tan(tilt) * rows) + far)
    strength = np.array([abs(np.exp(2j * np.pi * k * pixels).mean()) for k in _MULTIPLES])
    share, error = _amplitude(strength, count, None if spread is None else spread.in_pixels(frequency))
    first = complex(np.exp(2j * np.pi * pixels).mean())
    phase = float(np.angle(-np.conj(first) * np.sign(j1(2 * np.pi * share))))
    return Locking(share / frequency, error / frequency, 1 / frequency, phase, tilt, float(gain))


def _strongest_crowding(
    disparity: FloatArray, tangent: FloatArray, whole: float, share: float
) -> tuple[float, float, float, float]:
    """Frequency (1/px) within a share of `whole`, and tilt, at which disparities crowd most; how much; how many were tried.

    The mean of exp(2 pi i f d (1 - w y)) for all f and w is a Fourier transform over d and d y of the phases of whole pixels, in
    frequencies that are low beside those: the phases are gathered in bins of an eighth of their shortest cycle.
    """
    phasor = np.exp(2j * np.pi * whole * disparity)
    axes = [disparity - disparity.mean(), disparity * tangent]
    axes[1] = axes[1] - axes[1].mean()
    highest = [share * whole, (1 + share) * _TILT_UNKNOWN * whole]
    bins = [int(np.clip(np.ceil(np.ptp(x) * f * _BINS_A_CYCLE), 4, _MOST_BINS)) for x, f in zip(axes, highest, strict=True)]
    edges = [np.linspace(x.min(), x.max() + 1e-9, n + 1) for x, n in zip(axes, bins, strict=True)]
    real, imaginary = (np.histogram2d(axes[0], axes[1], bins=edges, weights=part)[0] for part in (phasor.real, phasor.imag))
    middles, steps = [(edge[1:] + edge[:-1]) / 2 for edge in edges], []
    found = real + 1j * imaginary
    for axis in (1, 0):
        reach = max(float(np.ptp(axes[axis])), 1e-9)
        tried = np.arange(-highest[axis], highest[axis], 1 / (_STEPS_A_CYCLE * reach))
        steps.append(tried)
        turned = np.exp(2j * np.pi * tried[:, None] * middles[axis])
        found = found @ turned.T if axis else turned @ found
    strength = np.abs(found) / len(disparity)
    row, column = np.unravel_index(int(np.argmax(strength)), strength.shape)
    frequency = whole + float(steps[1][row])
    return frequency, -float(steps[0][column]) / frequency, float(strength[row, column]), float(strength.size)


def _crowding(disparity: FloatArray, tangent: FloatArray, frequency: float, tilt: float) -> float:
    return float(abs(np.exp(2j * np.pi * frequency * disparity / (1 + np.tan(tilt) * tangent)).mean()))


def _refine_frequency(disparity: FloatArray, tangent: FloatArray, frequency: float, tilt: float) -> tuple[float, float]:
    """Frequency and tilt at the top of the crowding."""
    unit = 1 / float(np.ptp(disparity)), 1 / (frequency * max(float(np.ptp(disparity * tangent)), 1e-9))

    def less(at: FloatArray) -> float:
        if np.abs(at).max() > 1:
            return 0.0
        return -_crowding(disparity, tangent, frequency + at[0] * unit[0], tilt + at[1] * unit[1])

    top = minimize(less, np.zeros(2), method="Nelder-Mead", options={"initial_simplex": [[0, 0], [0.1, 0], [0, 0.1]]}).x
    return frequency + top[0] * unit[0], tilt + top[1] * unit[1]


def _amplitude(strength: FloatArray, count: int, spread: NoiseBounds | None) -> tuple[float, float]:
    """Amplitude and its standard deviation, matched pixels, from the mean of each multiple: least squares over blur and it.

    spread: in matched pixels.
    """

    def square(share: FloatArray, blur: FloatArray) -> FloatArray:
        harmonics = np.abs(jv(_MULTIPLES, 2 * np.pi * _MULTIPLES * share[:, None, None]))
        predicted = harmonics * np.exp(-2 * (np.pi * _MULTIPLES * blur[None, :, None]) ** 2)
        found = np.asarray(np.sum((predicted - strength) ** 2, axis=2) * 2 * count)
        if spread is None:
            return found
        least, most = spread.blurs(share)
        beyond = np.maximum(least[:, None] - blur, 0) + np.maximum(blur - most[:, None], 0)
        return np.asarray(found + (beyond / (_NOISE_UNCERTAINTY * spread.predicted)) ** 2)

    largest = thresholds().locking.most_noise
    shares, blurs = np.linspace(0.002, _LARGEST_AMPLITUDE, 400), np.linspace(0.0, largest, 60)
    coarse = square(shares, blurs)
    row = _plausible_minimum(shares, coarse.min(axis=1), float(np.sum(strength**2)) * 2 * count)
    for width in (0.01, 0.002):
        column = int(np.argmin(coarse[row]))
        shares = shares[row] + np.linspace(-width, width, 81)
        blurs = np.maximum(blurs[column] + np.linspace(-width, width, 41), 0.0)
        coarse = square(shares, blurs)
        row = int(np.argmin(coarse.min(axis=1)))
    best = float(coarse.min())
    # its spread, the blur free within what is allowed
    around = np.maximum(shares[row] + np.linspace(-_PROFILE_HALF_WIDTH, _PROFILE_HALF_WIDTH, 201), 0.0)
    profile = square(around, np.linspace(0.0, largest, 200)).min(axis=1)
    weight = np.exp(-0.5 * (profile - profile.min()) / max(best, 1.0))
    weight /= weight.sum()
    mean = float(weight @ around)
    return mean, float(np.sqrt(weight @ (around - mean) ** 2 + 1e-8))


def _plausible_minimum(shares: FloatArray, square: FloatArray, whole: float) -> int:
    """Row of the amplitude that is meant, of the minima of chi^2: Bessel functions come back to the same values.

    whole: chi^2 of no locking. Of amplitudes that fit alike it is the least; one that folds disparities over, from 1 / 2 pi on,
    has to fit well, and one beyond `_FAR` gives way to a small one that leaves as little as a matcher's curve is no sine.
    """
    lowest = (square <= np.append(square[1:], np.inf)) & (square <= np.append(np.inf, square[:-1]))
    rows = np.flatnonzero(lowest & (square < square.min() + thresholds().locking.equal_fit))
    unfolded = np.flatnonzero(lowest & (shares < _FOLDING))
    if len(unfolded):
        small = int(unfolded[np.argmin(square[unfolded])])
        if square.min() > thresholds().locking.good_fit or (
            shares[rows[0]] > _LARGE_AMPLITUDE and square[small] < _HARMONIC_MISFIT * whole
        ):
            return small
    return int(rows[0])
