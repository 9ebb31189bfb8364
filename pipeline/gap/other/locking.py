"""Pixel locking by the measured disparities alone: they crowd around the matched image's pixels, whatever the noise.

If d' = x + A sin(2 pi x / n + phase) and x is spread over many pixels, the mean of exp(2 pi i d' / n) is -J1(2 pi A / n)
exp(-i phase) (Jacobi-Anger), also where x holds noise that would average the sine away in the residuals. The k-th multiple of the
angle gives |Jk(2 pi k A / n)|; what blurs the disparities by s after the locking takes exp(-2 (pi k s / n)^2) of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1, jv

from pipeline.gap.decisions import decided
from scene.mesh import FloatArray

_REDUCTIONS = (1.0, 2.0, 4.0, 8.0)
_SCALE_UNKNOWN = 0.03
"""The rectification in which the disparities were found is not part of a measurement: its principal distance may be another."""
_BESIDE = np.concatenate([np.linspace(0.72, 0.9, 10), np.linspace(1.1, 1.28, 10)])
_LARGEST = 0.6
"""Amplitude in matched pixels."""
_MULTIPLES = np.arange(1, 5)
_FOLDING, _FAR, _NO_SINE = 1 / (2 * np.pi), 0.3, 0.02
_MOST_POINTS = 60_000


@dataclass(frozen=True)
class Locking:
    """amplitude_px, std_px; period_px: n; phase_rad in the nominal rectification; gain in log-likelihood."""

    amplitude_px: float
    std_px: float
    period_px: float
    phase_rad: float
    gain: float


def find_locking(disparity: FloatArray, reference: FloatArray) -> Locking | None:
    """The locking that measured disparities (n,), px, show, if any: n |R|^2 is exponential where there is none (Rayleigh).

    reference: (n,) disparities of the surface as known; what crowds there too is its shape.
    """
    thin = slice(None, None, max(len(disparity) // _MOST_POINTS, 1))
    some, known = disparity[thin], reference[thin]
    reach = float(np.ptp(np.quantile(some, [0.02, 0.98])))
    best: tuple[float, float, complex, int] | None = None
    for reduction in _REDUCTIONS:
        if reach < decided().locking.fewest_cycles * reduction:
            continue
        tried = np.arange((1 - _SCALE_UNKNOWN) / reduction, (1 + _SCALE_UNKNOWN) / reduction, 0.2 / reach)
        means, shape = np.abs(_means(some, tried)), np.abs(_means(known, np.concatenate([tried, _BESIDE / reduction])))
        frequency = _refined(some, float(tried[int(np.argmax(means))]), 0.2 / reach)
        mean = complex(_means(some, np.array([frequency]))[0])
        gain = len(some) * max(abs(mean) - decided().locking.crowding * float(shape.max()), 0.0) ** 2
        if best is None or gain > best[0]:
            best = gain, frequency, mean, len(tried)
    if best is None:
        return None
    gain, frequency, mean, count = best
    by_chance = min(1.0, len(_REDUCTIONS) * count * float(np.exp(-gain)))
    if by_chance > decided().locking.significance:
        return None
    share, error = _amplitude(np.array([abs(np.exp(2j * np.pi * k * frequency * some).mean()) for k in _MULTIPLES]), len(some))
    phase = float(np.angle(-np.conj(mean) * np.sign(j1(2 * np.pi * share))))
    return Locking(share / frequency, error / frequency, 1 / frequency, phase, float(gain))


def _amplitude(strength: FloatArray, count: int) -> tuple[float, float]:
    """Amplitude and its standard deviation, matched pixels, from the mean of each multiple: least squares over blur and it."""

    def square(share: FloatArray, blur: FloatArray) -> FloatArray:
        harmonics = np.abs(jv(_MULTIPLES, 2 * np.pi * _MULTIPLES * share[:, None, None]))
        predicted = harmonics * np.exp(-2 * (np.pi * _MULTIPLES * blur[None, :, None]) ** 2)
        return np.asarray(np.sum((predicted - strength) ** 2, axis=2) * 2 * count)

    shares, blurs = np.linspace(0.002, _LARGEST, 400), np.linspace(0.0, decided().locking.most_blur, 60)
    coarse = square(shares, blurs)
    row = _plausible(shares, coarse.min(axis=1), float(np.sum(strength**2)) * 2 * count)
    for width in (0.01, 0.002):
        column = int(np.argmin(coarse[row]))
        shares = shares[row] + np.linspace(-width, width, 81)
        blurs = np.maximum(blurs[column] + np.linspace(-width, width, 41), 0.0)
        coarse = square(shares, blurs)
        row = int(np.argmin(coarse.min(axis=1)))
    best = float(coarse.min())
    # the spread by curvature, the blur free
    around = shares[row] + np.linspace(-0.02, 0.02, 201)
    profile = square(around, np.linspace(0.0, decided().locking.most_blur, 200)).min(axis=1)
    weight = np.exp(-0.5 * (profile - profile.min()) / max(best, 1.0))
    weight /= weight.sum()
    mean = float(weight @ around)
    return mean, float(np.sqrt(weight @ (around - mean) ** 2 + 1e-8))


def _plausible(shares: FloatArray, square: FloatArray, whole: float) -> int:
    """Row of the amplitude that is meant, of the minima of chi^2: Bessel functions come back to the same values.

    whole: chi^2 of no locking. Of amplitudes that fit alike it is the least; one that folds disparities over, from 1 / 2 pi on,
    has to fit well, and one beyond `_FAR` gives way to a small one that leaves as little as a matcher's curve is no sine.
    """
    lowest = (square <= np.append(square[1:], np.inf)) & (square <= np.append(np.inf, square[:-1]))
    rows = np.flatnonzero(lowest & (square < square.min() + decided().locking.alike))
    unfolded = np.flatnonzero(lowest & (shares < _FOLDING))
    if len(unfolded):
        small = int(unfolded[np.argmin(square[unfolded])])
        if square.min() > decided().locking.fits or (shares[rows[0]] > _FAR and square[small] < _NO_SINE * whole):
            return small
    return int(rows[0])


def _means(disparity: FloatArray, frequencies: FloatArray) -> NDArray[np.complex128]:
    return np.array([np.exp(2j * np.pi * frequency * disparity).mean() for frequency in frequencies])


def _refined(disparity: FloatArray, frequency: float, step: float) -> float:
    for width in (step, step / 5, step / 25):
        tried = frequency + np.linspace(-width, width, 11)
        frequency = float(tried[int(np.argmax([abs(np.exp(2j * np.pi * each * disparity).mean()) for each in tried]))])
    return frequency
