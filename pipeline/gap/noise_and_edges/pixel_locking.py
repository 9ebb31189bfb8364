"""Find pixel locking from the measured disparities alone: they crowd around the pixels of the matched image, whatever the noise.

If d' = x + A sin(2 pi x / n + phase) and x is distributed over many pixels, the mean of exp(2 pi i d' / n) is -J1(2 pi A / n)
exp(-i phase) (Jacobi-Anger). This also holds where noise in x would average the sine away in the residuals. The k-th multiple of
the angle gives |Jk(2 pi k A / n)|. Noise of standard deviation s after the locking multiplies it by exp(-2 (pi k s / n)^2).

Residuals, plotted over the reference's disparities, show the sine. There, noise before the locking and errors of the reference,
of standard deviation t together, multiply its amplitude by exp(-2 (pi t / n)^2). With the variance of the residuals,
s^2 + t^2 + A^2 / 2, this tells a small amplitude from a large one that is hidden by noise, whichever comes first.

The rectification in which the disparities were matched is not part of a measurement. Another rectification has another principal
distance and may be rotated about the base by an angle w, so that d' = s d / (1 + y tan w). Here d is counted from the disparity
of a point at infinity, and y is the tangent of a row's angle to the axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, j1, jv

from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray

_REDUCTIONS = (1.0, 2.0, 4.0, 8.0)
"""Pixels of the matched image in pixels of the full one."""
_SCALE_UNKNOWN, _TILT_UNKNOWN = 0.03, 0.1
"""Relative uncertainty of the principal distance of the matcher's rectification, and uncertainty of its rotation about the base,
rad."""
_SHAPE_BAND = 0.18
"""Relative half-width of the band around the pixel frequency in which crowding of the reference counts as the wall's shape."""
_BAND_BESIDE = 0.4
"""Relative half-width of the band around the pixel frequency in which the crowding of measured disparities shows how many points
are independent."""
_BINS_A_CYCLE, _STEPS_A_CYCLE = 8, 4
"""Bins and trial frequencies for each cycle."""
_MOST_BINS = 4096
_LARGEST_AMPLITUDE = 0.6
"""Largest amplitude that is tried, in matched pixels."""
_PROFILE_HALF_WIDTH = 0.06
"""Half-width in matched pixels of the profile likelihood from which the standard deviation is taken: twice the smallest amplitude
that shows in the noise."""
_NOISE_UNCERTAINTY, _LEAST_NOISE_SHARE = 0.1, 0.01
"""Relative uncertainty of the noise; least share of the measured variance that is noise."""
_MULTIPLES = np.arange(1, 5)
_MOST_NOISE_PX = 0.35
"""Largest standard deviation of matching noise that is tried, px: with more noise, locked disparities look evenly spread."""
_FOLDING, _LARGE_AMPLITUDE, _HARMONIC_MISFIT = 1 / (2 * np.pi), 0.3, 0.02
"""Amplitude from which disparities fold over; amplitude that is large; chi^2 share by which a small amplitude may fit worse,
because a matcher's error is not exactly a sine."""
_CLIP = 3.0
"""Residuals beyond so many standard deviations are clipped."""
_FIRST_BESIDE, _SINES_BESIDE = 2, 12
"""Frequencies beside that of the locking: distance of the first one, in cycles over all disparities; number on each side."""
_MOST_POINTS = 60_000


@dataclass(frozen=True)
class Locking:
    """Pixel locking that was found: a matcher's systematic error of the disparity, a sine that repeats with each pixel.

    Attributes
    ----------
    amplitude_px, std_px : amplitude of the sine and its standard deviation, px.
    period_px : period of the sine: size of a pixel of the image that was matched, px of the full image; above 1 if the image
        was reduced.
    phase_rad : phase of the sine at disparity 0, rad.
    tilt_rad : rotation about the base by which the matcher's rectification differs from ours, rad.
    gain : log-likelihood ratio against no locking.
    """

    amplitude_px: float
    std_px: float
    period_px: float
    phase_rad: float
    tilt_rad: float
    gain: float


@dataclass(frozen=True)
class NoiseBounds:
    """Bounds of the standard deviation of matching noise, before and after pixel locking together.

    Without bounds, a small amplitude with much noise could not be told from a large one with little noise.

    Attributes
    ----------
    predicted : standard deviation of the noise in the sensor model, px.
    measured : standard deviation of the residuals, which contain noise and locking together, px.
    """

    predicted: float
    measured: float


def find_locking(
    disparity: FloatArray,
    reference: FloatArray,
    tangent: FloatArray | float = 0.0,
    infinity: FloatArray | float = 0.0,
    noise: NoiseBounds | None = None,
    residual: FloatArray | None = None,
) -> Locking | None:
    """Find pixel locking: measured disparities crowd around certain fractions of a pixel. None if not significant.

    A disparity is converted to a phase, in which a whole pixel is 2 pi. The test statistic is R, the mean of exp(i phase) over
    n independent points. Without locking, n |R|^2 is exponentially distributed (Rayleigh test). Two tests must be significant: of
    what is left of |R| beside the shape of the wall, with the number of points as n; and of |R| with 1 over the mean of |R|^2 at
    frequencies that no matcher has as n, because correlated disparities count as fewer independent ones.

    Parameters
    ----------
    disparity : (n,) measured disparities, px.
    reference : (n,) disparities of the reference, px. Crowding in these is due to the shape of the wall.
    tangent : (n,) vertical slope of each point's line of sight: (rectified row - principal row) / focal length in px.
    infinity : disparity of a point at infinity, px, from which disparities are counted.
    noise : bounds of the matching noise, px; None if it is unknown.
    residual : (n,) disparities minus those of the registered reference, px; used with `noise` only. They show the sine, damped
        by the noise before it.
    """
    every = slice(None, None, max(len(disparity) // _MOST_POINTS, 1))
    far = np.broadcast_to(infinity, disparity.shape)[every]
    disparities, known, rows = disparity[every] - far, reference[every] - far, np.broadcast_to(tangent, disparity.shape)[every]
    count, reach = len(disparities), float(np.ptp(np.quantile(disparities, [0.02, 0.98])))
    found = [
        _Crowding.of(disparities, known, rows, 1 / reduction)
        for reduction in _REDUCTIONS
        if reach >= thresholds().locking.fewest_cycles * reduction
    ]
    if not found:
        return None
    best = max(found, key=lambda each: each.excess)
    independent, gain = _independent_points(disparities, rows, best.whole, reach), count * best.excess**2
    p_value = min(1.0, len(_REDUCTIONS) * best.tries * float(np.exp(-min(gain, independent * best.strength**2))))
    if p_value > thresholds().locking.significance:
        return None
    frequency, turned = best.frequency, 1 + np.tan(best.tilt) * rows
    pixels = frequency * (disparities / turned + far)
    phasors = [np.exp(2j * np.pi * k * pixels).mean() for k in _MULTIPLES]
    allowed = None if noise is None else NoiseBounds(noise.predicted * frequency, noise.measured * frequency)
    sine = None
    if noise is not None and residual is not None:
        left = residual[every]
        clipped = np.clip(left - np.median(left), -_CLIP * noise.measured, _CLIP * noise.measured)
        sine = _sine_of_residuals(frequency * clipped, pixels - frequency * left / turned, frequency * reach)
    share, error = _amplitude(np.array([abs(each) for each in phasors]), count, allowed, sine)
    phase = float(np.angle(-np.conj(phasors[0]) * np.sign(j1(2 * np.pi * share))))
    return Locking(share / frequency, error / frequency, 1 / frequency, phase, best.tilt, float(gain))


@dataclass(frozen=True)
class _Crowding:
    """How strongly disparities crowd around whole pixels, of the full image or of a smaller one in which the matcher worked.

    whole: frequency of its pixels, 1/px; frequency (1/px), tilt (rad): where the disparities crowd most; strength: mean resultant
    length of the phases; excess: strength less what the shape of the wall may cause; tries: number of frequencies and tilts.
    """

    whole: float
    frequency: float
    tilt: float
    strength: float
    excess: float
    tries: int

    @classmethod
    def of(cls, disparity: FloatArray, known: FloatArray, tangent: FloatArray, whole: float) -> _Crowding:
        """Find where the disparities crowd most. known: (n,) disparities of the reference; others as in `_strongest_crowding`."""
        frequency, tilt, strength = _strongest_crowding(disparity, tangent, whole, _SCALE_UNKNOWN)
        _, _, of_reference = _strongest_crowding(known, tangent, whole, _SHAPE_BAND)
        shape = np.sqrt(max(of_reference.max() ** 2 - np.log(of_reference.size) / len(disparity), 0.0))
        frequency, tilt = _refine_frequency(disparity, tangent, frequency, tilt)
        found = _crowding(disparity, tangent, frequency, tilt)
        excess = max(found - thresholds().locking.crowding_ratio * shape, 0.0)
        return cls(whole, frequency, tilt, found, excess, strength.size)


def _independent_points(disparity: FloatArray, tangent: FloatArray, whole: float, reach: float) -> float:
    """Return the number of independent points that would crowd as much by chance, at frequencies that no matcher has.

    The mean of |R|^2 over n independent points is 1 / n. reach: range of the disparities, px.
    """
    near = _SCALE_UNKNOWN * whole + _FIRST_BESIDE / reach
    _, _, beside = _strongest_crowding(disparity, tangent, whole, max(_BAND_BESIDE, 2 * near / whole), near)
    return min(len(disparity), 1 / float(np.mean(beside**2)))


def _strongest_crowding(
    disparity: FloatArray, tangent: FloatArray, whole: float, share: float, near: float = 0.0
) -> tuple[float, float, FloatArray]:
    """Find the frequency (1/px) and the tilt at which disparities crowd most around whole pixels.

    Returns the frequency, which is within a share of `whole` but not nearer to it than `near`, the tilt, and how strongly they
    crowd at each that is tried. The mean of exp(2 pi i f d (1 - w y)) for all f and w is a Fourier transform over d and d y
    of the phasors of whole pixels. Its frequencies are low, so the phasors are gathered in bins of an eighth of their shortest
    cycle.
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
        tried = tried if axis else tried[np.abs(tried) >= near]
        steps.append(tried)
        turned = np.exp(2j * np.pi * tried[:, None] * middles[axis])
        found = found @ turned.T if axis else turned @ found
    strength = np.abs(found) / len(disparity)
    row, column = np.unravel_index(int(np.argmax(strength)), strength.shape)
    frequency = whole + float(steps[1][row])
    return frequency, -float(steps[0][column]) / frequency, strength


def _crowding(disparity: FloatArray, tangent: FloatArray, frequency: float, tilt: float) -> float:
    """Mean resultant length of the phases."""
    return float(abs(np.exp(2j * np.pi * frequency * disparity / (1 + np.tan(tilt) * tangent)).mean()))


def _refine_frequency(disparity: FloatArray, tangent: FloatArray, frequency: float, tilt: float) -> tuple[float, float]:
    """Frequency and tilt at the maximum of the crowding."""
    unit = 1 / float(np.ptp(disparity)), 1 / (frequency * max(float(np.ptp(disparity * tangent)), 1e-9))

    def negative_strength(at: FloatArray) -> float:
        if np.abs(at).max() > 1:
            return 0.0
        return -_crowding(disparity, tangent, frequency + at[0] * unit[0], tilt + at[1] * unit[1])

    top = minimize(
        negative_strength, np.zeros(2), method="Nelder-Mead", options={"initial_simplex": [[0, 0], [0.1, 0], [0, 0.1]]}
    ).x
    return frequency + top[0] * unit[0], tilt + top[1] * unit[1]


def _sine_of_residuals(residual: FloatArray, pixels: FloatArray, cycles: float) -> tuple[float, float]:
    """Return the amplitude of the sine in the residuals and its standard deviation, in matched pixels.

    The standard deviation follows from sines of other frequencies nearby, so it contains what is correlated in the residuals.

    Parameters
    ----------
    residual : (n,) residuals, matched pixels.
    pixels : (n,) disparities of the reference, matched pixels.
    cycles : number of matched pixels over which these are spread.
    """
    beside = np.arange(_FIRST_BESIDE, _FIRST_BESIDE + _SINES_BESIDE) / cycles
    frequencies = 1 + np.concatenate([[0.0], beside, -beside])
    found = np.array([2 * abs(np.mean(residual * np.exp(-2j * np.pi * each * pixels))) for each in frequencies])
    return float(found[0]), float(np.sqrt(np.mean(found[1:] ** 2) / 2))


def _amplitude(
    strength: FloatArray, count: int, noise: NoiseBounds | None, sine: tuple[float, float] | None
) -> tuple[float, float]:
    """Estimate the amplitude of pixel locking and its standard deviation, in matched pixels.

    This is a least-squares fit of amplitude and noise to the mean phasor of each multiple of the frequency, and to the sine.

    Parameters
    ----------
    strength : (4,) absolute values of the mean phasors.
    count : number of points.
    noise : bounds of the noise, matched pixels.
    sine : amplitude in the residuals and its standard deviation, matched pixels. None: all noise comes after the locking.
    """

    def misfit_of_noise(share: FloatArray, blur: FloatArray, noise: NoiseBounds) -> FloatArray:
        # the measured variance contains noise and locking, so a larger amplitude leaves less for the noise
        variance = np.maximum(noise.measured**2 - share**2 / 2, _LEAST_NOISE_SHARE * noise.measured**2)
        left, unit = np.sqrt(variance)[:, None], _NOISE_UNCERTAINTY * noise.predicted
        least = (1 - _NOISE_UNCERTAINTY) * np.minimum(left, noise.predicted)
        most = (1 + _NOISE_UNCERTAINTY) * np.maximum(left, noise.predicted)
        if sine is None:
            return np.asarray((np.maximum(least - blur, 0) + np.maximum(blur - most, 0)) ** 2 / unit**2)
        lowest, highest = (
            share[:, None] * np.exp(-2 * np.pi**2 * np.maximum(before**2 - blur**2, 0.0)) for before in (most, least)
        )
        beyond = np.maximum(lowest - sine[0], 0) + np.maximum(sine[0] - highest, 0)
        return np.asarray((np.maximum(blur - most, 0) / unit) ** 2 + (beyond / sine[1]) ** 2)

    def chi2(share: FloatArray, blur: FloatArray) -> FloatArray:
        harmonics = np.abs(jv(_MULTIPLES, 2 * np.pi * _MULTIPLES * share[:, None, None]))
        predicted = harmonics * np.exp(-2 * (np.pi * _MULTIPLES * blur[None, :, None]) ** 2)
        found = np.asarray(np.sum((predicted - strength) ** 2, axis=2) * 2 * count)
        return found if noise is None else found + misfit_of_noise(share, blur, noise)

    largest = _MOST_NOISE_PX
    shares, blurs = np.linspace(0.002, _LARGEST_AMPLITUDE, 400), np.linspace(0.0, largest, 60)
    coarse = chi2(shares, blurs)
    row = _plausible_minimum(shares, coarse.min(axis=1), float(np.sum(strength**2)) * 2 * count)
    for width in (0.01, 0.002):
        column = int(np.argmin(coarse[row]))
        shares = shares[row] + np.linspace(-width, width, 81)
        blurs = np.maximum(blurs[column] + np.linspace(-width, width, 41), 0.0)
        coarse = chi2(shares, blurs)
        row = int(np.argmin(coarse.min(axis=1)))
    best = float(coarse.min())
    # standard deviation of the amplitude, with the noise free within its bounds
    around = np.maximum(shares[row] + np.linspace(-_PROFILE_HALF_WIDTH, _PROFILE_HALF_WIDTH, 201), 0.0)
    profile = chi2(around, np.linspace(0.0, largest, 200)).min(axis=1)
    weight = np.exp(-0.5 * (profile - profile.min()) / max(best, 1.0))
    weight /= weight.sum()
    mean = float(weight @ around)
    return mean, float(np.sqrt(weight @ (around - mean) ** 2 + 1e-8))


def _plausible_minimum(shares: FloatArray, chi2: FloatArray, whole: float) -> int:
    """Choose among the minima of chi^2 the row of the plausible amplitude, because Bessel functions repeat their values.

    Of amplitudes that fit equally well the smallest is taken. An amplitude that folds disparities over, from 1 / 2 pi on, must
    fit well. A large one gives way to a small one that leaves as little as a matcher's deviation from a sine. whole: chi^2
    without locking.
    """
    lowest = (chi2 <= np.append(chi2[1:], np.inf)) & (chi2 <= np.append(np.inf, chi2[:-1]))
    rows = np.flatnonzero(lowest & (chi2 < chi2.min() + 2 * thresholds().mean.class_margin))
    unfolded = np.flatnonzero(lowest & (shares < _FOLDING))
    if len(unfolded):
        small = int(unfolded[np.argmin(chi2[unfolded])])
        if chi2.min() > chdtri(len(_MULTIPLES), thresholds().mean.significance) or (
            shares[rows[0]] > _LARGE_AMPLITUDE and chi2[small] < _HARMONIC_MISFIT * whole
        ):
            return small
    return int(rows[0])
