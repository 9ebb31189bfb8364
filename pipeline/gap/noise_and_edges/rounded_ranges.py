"""Find the step to which ranges were rounded: a comb in their histogram, which is a line in its Fourier transform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.gap.thresholds import thresholds
from scene.geometry.mesh import FloatArray

_BIN_M = 1e-5
"""Width of a bin of the histogram, m."""
_SMALLEST_STEP_M, _LARGEST_STEP_M = 5e-5, 0.05


@dataclass(frozen=True)
class RangeStep:
    """The step, such as 1 mm, to which a scanner rounds its ranges, as found in recorded ranges.

    Attributes
    ----------
    step_m, std_m : the step and its standard deviation, which follows from the resolution of the search, m.
    strength : mean resultant length of the ranges modulo the step: 1 if all are exact multiples, 0 if none are rounded.
    """

    step_m: float
    std_m: float
    strength: float


def find_range_step(ranges: FloatArray) -> RangeStep | None:
    """Find the step to which recorded ranges are rounded.

    It is not found if the ranges were computed from coordinates that the file rounds, because these ranges take any value.

    Parameters
    ----------
    ranges : (n,) ranges, m.

    Returns
    -------
    RangeStep or None : the step, counted from range 0; None if the ranges are not rounded.
    """
    low, reach = float(ranges.min()), float(np.ptp(ranges))
    if len(ranges) < 200 or reach < 20 * _LARGEST_STEP_M:
        return None
    counts = np.bincount(((ranges - low) / _BIN_M).astype(np.int64))
    size = int(2 ** np.ceil(np.log2(len(counts) + 1)))
    strength = np.abs(np.fft.rfft(counts, size)) / len(ranges)
    frequency = np.arange(len(strength)) / (size * _BIN_M)
    allowed = (frequency > 1 / _LARGEST_STEP_M) & (frequency < 1 / _SMALLEST_STEP_M)
    candidates = np.flatnonzero(allowed & (strength > thresholds().quantization.least_resultant))
    if not len(candidates):
        return None
    first = candidates[0]  # the fundamental frequency; its multiples are higher
    near = slice(first, first + int(0.1 * first) + 2)
    peak = first + int(np.argmax(strength[near]))
    step = _refine_step(ranges, 1 / float(frequency[peak]), reach)
    coherence = float(np.abs(np.exp(2j * np.pi * ranges / step).mean()))
    return RangeStep(step, 1e-4 * step**2 / reach, coherence) if coherence > thresholds().quantization.least_resultant else None


def _refine_step(ranges: FloatArray, step: float, reach: float) -> float:
    """Maximise the resultant at phase 0: multiples are counted from range 0, which determines the step far better."""
    few_ranges = ranges[:: max(len(ranges) // 4000, 1)]
    for width in (step**2 / reach, 0.05 * step**2 / float(ranges.max())):
        trial = step + np.linspace(-width, width, 401)
        step = float(trial[np.argmax([np.cos(2 * np.pi * few_ranges / each).mean() for each in trial])])
    return step
