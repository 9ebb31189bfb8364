"""Fit the probability of detection over block size, and estimate the size from which 95 % of the blocks are detected.

The share detected at size x is P(x) = (1 - l) Phi((ln x - m) / w), with the lapse rate l. The size of interest has the logarithm

    t = m + w Phi^-1(0.95 / (1 - l))   (none where l >= 0.05: no size reaches 95 %).

Blocks of few sizes determine t poorly. If all small blocks are missed and all large ones detected, every t between them is
equally likely (complete separation); if all are detected, every smaller t is. Therefore t is estimated from its profile
likelihood

    L(t) = max over w and l of the log-likelihood of the blocks, at m = t - w Phi^-1(0.95 / (1 - l)),

on a grid of t, w and l, together with L(none), the maximum over l >= 0.05. The 95 % interval is the range within 2.51 of the
maximum (Wilks 1938 has 1.92; the value is larger because l often lies on its bound). It is open upwards if `none` lies within it,
and open at an end of the grid. The estimate is the middle of the maximum, which is flat under separation, so that it always lies
in the interval. If no block has a size near the estimate, the sizes between which it lies are given instead of a number.

The fit assumes that blocks are detected independently. tests/pipeline/test_detection_curve.py checks the interval's coverage.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal, special

from scene.geometry.mesh import FloatArray

BoolArray = NDArray[np.bool_]
LEAST_BLOCKS = 10
"""Smallest number of blocks for a fit."""
SHARE = 0.95
"""Share detected that defines the smallest block."""
GAP = 1.5
"""Ratio of neighbouring sizes above which an estimate between them is not given as a number."""
_WITHIN = 2.512
"""Half the 97.5 % quantile of the chi-square distribution with one degree of freedom. With the 95 % quantile, the intervals
covered the true value in only 89 % of simulated cases with l on its bound of 0 and 200 blocks.
"""
_FLAT = 0.02
"""Log-likelihoods this near to the maximum count as equal to it."""
_STEP, _BEYOND = 0.025, 1.0
"""Step of the grid of ln t, and its extent beyond the block sizes."""
_LEAST_CHANCE = 1e-9
"""Smallest probability, to keep logarithms finite."""
_WIDTHS, _COARSE, _FINE = (0.02, 1.5), 10, 60
"""Range of w, and numbers of coarse and of fine steps."""
_LAPSES = np.array([0.0, 0.005, 0.01, 0.02, 0.03, 0.04, 0.049])
"""Lapse rates with which some size reaches 95 %."""
_LAPSES_OF_NONE = np.array([0.051, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 0.9])
"""Lapse rates with which no size does."""


@dataclass(frozen=True)
class DetectionCurve:
    """Probability P that a fallen block of size x (or depth x) is detected, fitted to the detected and missed blocks.

    The curve is P(x) = (1 - lapse) Phi((ln x - ln middle) / width), where Phi is the normal distribution function.

    Attributes
    ----------
    count, seen : Number of blocks, and of those detected.
    smallest_m, largest_m : Range of the block sizes, m.
    middle_m : Size at half of the curve's height, m.
    width : Width of the curve's rise, in natural logarithms of size.
    lapse : Share of blocks that is missed at any size.
    smallest_95_m : Size from which 95 % are detected, m. None if it is known less well than to a factor of 1.5, or if the
        curve stays below 95 %.
    between_m : Only if `smallest_95_m` is not known well enough: the neighbouring block sizes between which it lies, m.
        The lower one is None if it lies below all sizes, the upper one if it lies above all.
    interval_m : 95 % confidence interval of the size from which 95 % are detected, m; None for an end that the blocks do
        not bound.
    """

    count: int
    seen: int
    smallest_m: float
    largest_m: float
    middle_m: float
    width: float
    lapse: float
    smallest_95_m: float | None
    between_m: tuple[float | None, float | None] | None
    interval_m: tuple[float | None, float | None]

    def probability(self, size_m: FloatArray) -> FloatArray:
        """Return the probability that blocks of given sizes are detected, 0 to 1.

        size_m: sizes (or depths) in m, an array of any shape. Returns an array of the same shape.
        """
        return (1 - self.lapse) * special.ndtr((np.log(size_m) - np.log(self.middle_m)) / self.width)

    def to_dict(self) -> dict[str, Any]:
        """Return all parameters of a detection curve as a dictionary for `comparison.json`."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class _ProfileLikelihood:
    """Profile likelihood of ln t.

    Attributes
    ----------
    at : (n,) values of ln t.
    likelihood : (n,) maximum log-likelihood at each.
    parameters : (n, 3) m, w and l of that maximum.
    none, none_parameters : Log-likelihood and parameters of the likeliest curve that never reaches 95 %.
    """

    at: FloatArray
    likelihood: FloatArray
    parameters: FloatArray
    none: float
    none_parameters: FloatArray

    @property
    def maximum(self) -> float:
        """The largest log-likelihood."""
        return max(float(self.likelihood.max()), self.none)

    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of ln t; infinite where it is open."""
        limit = self.maximum - _WITHIN
        inside = np.flatnonzero(self.likelihood >= limit)
        if len(inside) == 0:
            return -np.inf, np.inf
        first, last = inside[[0, -1]]
        low = -np.inf if first == 0 else self._crossing(first - 1, first, limit)
        high = np.inf if last == len(self.at) - 1 or self.none >= limit else self._crossing(last, last + 1, limit)
        return low, high

    def _crossing(self, left: int, right: int, limit: float) -> float:
        """Interpolate where the likelihood passes a limit between two neighbours of the grid."""
        (a, b), (p, q) = self.at[[left, right]], self.likelihood[[left, right]]
        return float(a + (b - a) * np.clip((limit - p) / (q - p), 0.0, 1.0))

    def likeliest(self) -> tuple[float, FloatArray]:
        """Return ln t (infinite: never 95 %) and m, w, l at the middle of the flat maximum."""
        if self.none > self.likelihood.max() + _FLAT:
            return np.inf, self.none_parameters
        flat = np.flatnonzero(self.likelihood >= self.likelihood.max() - _FLAT)
        place = int(flat[np.argmin(np.abs(self.at[flat] - (self.at[flat[0]] + self.at[flat[-1]]) / 2))])
        return float(self.at[place]), self.parameters[place]


def detection_curve(size_m: FloatArray, seen: BoolArray) -> DetectionCurve | None:
    """Fit the probability of detection as a function of block size, to find the smallest block that a sensor detects reliably.

    Parameters
    ----------
    size_m : (k,) sizes (or depths) of the blocks in view, m.
    seen : (k,) true for the blocks that were detected.

    Returns
    -------
    The curve; None for fewer than ten blocks.
    """
    if len(size_m) < LEAST_BLOCKS:
        return None
    log_size = np.log(size_m)
    profile = _profile(log_size, seen)
    at, (middle, width, lapse) = profile.likeliest()
    low, high = profile.interval()
    between = _gap_around(at, np.unique(log_size))
    return DetectionCurve(
        count=len(seen),
        seen=int(np.count_nonzero(seen)),
        smallest_m=float(size_m.min()),
        largest_m=float(size_m.max()),
        middle_m=float(np.exp(middle)),
        width=float(width),
        lapse=float(lapse),
        smallest_95_m=None if between is not None else _metres(at),
        between_m=None if between is None else (_metres(between[0]), _metres(between[1])),
        interval_m=(_metres(low), _metres(high)),
    )


def _gap_around(at: float, sizes: FloatArray) -> tuple[float, float] | None:
    """Return the two sorted log sizes around t if they are far apart; None if they are not or t is infinite."""
    if not np.isfinite(at):
        return None
    place = int(np.searchsorted(sizes, at))
    low = sizes[place - 1] if place > 0 else -np.inf
    high = sizes[place] if place < len(sizes) else np.inf
    return (float(low), float(high)) if high - low > np.log(GAP) else None


def _profile(log_size: FloatArray, seen: BoolArray) -> _ProfileLikelihood:
    """Compute the profile likelihood on a grid of ln t, where t is the size that is detected in 95 % of cases.

    The maximum is searched over coarse widths first, and then over fine ones around the likely ones.
    """
    coarse = np.geomspace(*_WIDTHS, _COARSE)
    best = [_of_width(width, log_size, seen).maximum for width in coarse]
    likely = np.flatnonzero(np.array(best) > max(best) - 3 * _WITHIN)
    first, last = max(likely[0] - 1, 0), min(likely[-1] + 1, _COARSE - 1)
    fine = np.geomspace(coarse[first], coarse[last], int((last - first) / _COARSE * _FINE) + 2)
    found = [_of_width(width, log_size, seen) for width in fine]
    place = np.argmax([each.likelihood for each in found], axis=0)
    columns = np.arange(len(place))
    none = max(found, key=lambda each: each.none)
    return _ProfileLikelihood(
        found[0].at,
        np.stack([each.likelihood for each in found])[place, columns],
        np.stack([each.parameters for each in found])[place, columns],
        none.none,
        none.none_parameters,
    )


def _of_width(width: float, log_size: FloatArray, seen: BoolArray) -> _ProfileLikelihood:
    """Compute the profile likelihood over the lapse rates for one width."""
    low, high = float(log_size.min()) - _BEYOND, float(log_size.max()) + _BEYOND
    at = np.linspace(low, high, int(np.ceil((high - low) / _STEP)) + 1)
    quantiles = special.ndtri(SHARE / (1 - _LAPSES))
    begin = low - width * quantiles.max()
    middle = np.linspace(begin, high, int((high - begin) / max(_STEP / 5, width / 16)) + 2)
    found = _log_likelihoods(middle, width, np.concatenate([_LAPSES, _LAPSES_OF_NONE]), log_size, seen)
    middles = at - width * quantiles[:, None]
    likelihoods = np.stack([np.interp(wanted, middle, each) for wanted, each in zip(middles, found, strict=False)])
    place, columns = np.argmax(likelihoods, axis=0), np.arange(len(at))
    parameters = np.stack([middles[place, columns], np.full(len(at), width), _LAPSES[place]], axis=1)
    beyond = found[len(_LAPSES) :]
    row, column = np.unravel_index(int(beyond.argmax()), beyond.shape)
    of_none = np.array([middle[column], width, _LAPSES_OF_NONE[row]])
    return _ProfileLikelihood(at, likelihoods[place, columns], parameters, float(beyond[row, column]), of_none)


def _log_likelihoods(grid: FloatArray, width: float, lapses: FloatArray, log_size: FloatArray, seen: BoolArray) -> FloatArray:
    """Return the (lapses, n) log-likelihoods of curves with their middles on a regular grid (n,) that covers all sizes.

    A block counts in parts at its two neighbours on the grid, so that the sums over the blocks are convolutions.
    """
    number = len(grid)
    lag = (grid[1] - grid[0]) * np.arange(number - 1, -number, -1) / width
    of_seen = np.maximum(special.log_ndtr(lag), np.log(_LEAST_CHANCE))[None]
    of_missed = np.log1p(-np.minimum((1 - lapses)[:, None] * special.ndtr(lag), 1 - _LEAST_CHANCE))
    parts = [
        signal.fftconvolve(_shared_out(log_size[chosen], grid)[None], terms, axes=1)[:, number - 1 : 2 * number - 1]
        for chosen, terms in ((seen, of_seen), (~seen, of_missed))
    ]
    return np.count_nonzero(seen) * np.log1p(-lapses)[:, None] + parts[0] + parts[1]


def _shared_out(values: FloatArray, grid: FloatArray) -> FloatArray:
    """Return how many values (n,) there are at each node of a regular grid, each divided linearly between its two neighbours."""
    place = (values - grid[0]) / (grid[1] - grid[0])
    below = np.floor(place).astype(int)
    part = place - below
    shared = np.bincount(below, 1 - part, len(grid)) + np.bincount(below + 1, part, len(grid))
    return np.asarray(shared, dtype=np.float64)  # without values bincount gives integers


def _metres(logarithm: float) -> float | None:
    """Convert a logarithm to metres; None if it is infinite."""
    return float(np.exp(logarithm)) if np.isfinite(logarithm) else None
