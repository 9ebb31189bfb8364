"""The curve of blocks seen over their size, and the size from which 95 % are seen with all that the blocks leave open about it.

The share seen at size x is P(x) = (1 - l) Phi((ln x - m) / w), and the size looked for is

    t = m + w Phi^-1(0.95 / (1 - l))   (its logarithm; none where l >= 0.05: no size is seen so often).

Blocks of few sizes leave much of this open: where all small ones were missed and all large ones seen, every t between them is
equally likely (complete separation), where all were seen every smaller one. So t is judged by its profile likelihood

    L(t) = max over w and l of the log-likelihood of the blocks, at m = t - w Phi^-1(0.95 / (1 - l)),

on a grid of t, w and l, beside L(none), the maximum over l >= 0.05. The interval of 95 % is what lies within 2.51 of the
maximum (Wilks 1938; somewhat more than his 1.92, as l often lies on its bound); it is open upwards where `none` lies within it,
and at an end of the grid. The estimate is the middle of the maximum, which is flat under separation, and so lies in the interval
always. Where no block fell of a size near the estimate, no number is given but the sizes between which it lies.

Assumes that blocks are seen or missed independently. How often the interval holds the truth is tested in
tests/pipeline/test_detection_curve.py.
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
SHARE = 0.95
GAP = 1.5
"""Neighbouring sizes farther apart than by this factor leave a gap: a number in it would be a guess."""
_WITHIN = 2.512
"""Half the 97.5 % quantile of the chi-square distribution of one degree of freedom. With that of 95 % the intervals held the
truth in 89 % of simulated cases where l is on its bound of 0 and 200 blocks fell."""
_FLAT = 0.02
"""Log-likelihoods this near to the maximum count as equal to it."""
_STEP, _BEYOND = 0.025, 1.0
"""Of the grid of ln t, and how far it goes beyond the sizes."""
_LEAST_CHANCE = 1e-9
"""That a block is missed: keeps logarithms finite."""
_WIDTHS, _COARSE, _FINE = (0.02, 1.5), 10, 60
_LAPSES = np.array([0.0, 0.005, 0.01, 0.02, 0.03, 0.04, 0.049])
_LAPSES_OF_NONE = np.array([0.051, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 0.9])


@dataclass(frozen=True)
class DetectionCurve:
    """P(x) = (1 - lapse) Phi((ln x - ln middle) / width), fitted to `count` blocks of sizes from smallest_m to largest_m.

    seen: how many of them were; smallest_95_m: the size from which 95 % are seen, None where the blocks do not tell it to a
    factor of 1.5: it then lies between between_m[0] and between_m[1] (None: below all sizes, or above all or nowhere), or, with
    between_m None, the curve stays below 95 %. interval_m: of 95 %; an end is None where the blocks do not bound it.
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
        """The share seen at sizes, m."""
        return (1 - self.lapse) * special.ndtr((np.log(size_m) - np.log(self.middle_m)) / self.width)

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class _Profile:
    """The likeliest curve for each t. at: (n,) ln t; likelihood: (n,); parameters: (n, 3) m, w, l; none: likelihood and
    parameters of the likeliest curve that never reaches the share."""

    at: FloatArray
    likelihood: FloatArray
    parameters: FloatArray
    none: float
    none_parameters: FloatArray

    @property
    def maximum(self) -> float:
        return max(float(self.likelihood.max()), self.none)

    def interval(self) -> tuple[float, float]:
        """Of t; minus infinity and infinity where it is open."""
        limit = self.maximum - _WITHIN
        inside = np.flatnonzero(self.likelihood >= limit)
        if len(inside) == 0:
            return -np.inf, np.inf
        first, last = inside[[0, -1]]
        low = -np.inf if first == 0 else self._crossing(first - 1, first, limit)
        high = np.inf if last == len(self.at) - 1 or self.none >= limit else self._crossing(last, last + 1, limit)
        return low, high

    def _crossing(self, left: int, right: int, limit: float) -> float:
        """Where the likelihood passes a limit between two neighbours of the grid."""
        (a, b), (p, q) = self.at[[left, right]], self.likelihood[[left, right]]
        return float(a + (b - a) * np.clip((limit - p) / (q - p), 0.0, 1.0))

    def likeliest(self) -> tuple[float, FloatArray]:
        """t (infinite: none) and the parameters m, w, l there: the middle of what is as likely as the maximum."""
        if self.none > self.likelihood.max() + _FLAT:
            return np.inf, self.none_parameters
        flat = np.flatnonzero(self.likelihood >= self.likelihood.max() - _FLAT)
        place = int(flat[np.argmin(np.abs(self.at[flat] - (self.at[flat[0]] + self.at[flat[-1]]) / 2))])
        return float(self.at[place]), self.parameters[place]


def detection_curve(size_m: FloatArray, seen: BoolArray) -> DetectionCurve | None:
    """Fit the curve to blocks of sizes (k,), m, seen or not (k,); None for fewer than ten blocks."""
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
    """The neighbours of t among the sizes (logarithms, in order) where they are far apart; None where not, and for no t."""
    if not np.isfinite(at):
        return None
    place = int(np.searchsorted(sizes, at))
    low = sizes[place - 1] if place > 0 else -np.inf
    high = sizes[place] if place < len(sizes) else np.inf
    return (float(low), float(high)) if high - low > np.log(GAP) else None


def _profile(log_size: FloatArray, seen: BoolArray) -> _Profile:
    """The profile likelihood on a grid of ln t: over coarse widths first, then over fine ones where those are likely."""
    coarse = np.geomspace(*_WIDTHS, _COARSE)
    best = [_of_width(width, log_size, seen).maximum for width in coarse]
    likely = np.flatnonzero(np.array(best) > max(best) - 3 * _WITHIN)
    first, last = max(likely[0] - 1, 0), min(likely[-1] + 1, _COARSE - 1)
    fine = np.geomspace(coarse[first], coarse[last], int((last - first) / _COARSE * _FINE) + 2)
    found = [_of_width(width, log_size, seen) for width in fine]
    place = np.argmax([each.likelihood for each in found], axis=0)
    columns = np.arange(len(place))
    none = max(found, key=lambda each: each.none)
    return _Profile(
        found[0].at,
        np.stack([each.likelihood for each in found])[place, columns],
        np.stack([each.parameters for each in found])[place, columns],
        none.none,
        none.none_parameters,
    )


def _of_width(width: float, log_size: FloatArray, seen: BoolArray) -> _Profile:
    """The profile over lapses alone."""
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
    return _Profile(at, likelihoods[place, columns], parameters, float(beyond[row, column]), of_none)


def _log_likelihoods(grid: FloatArray, width: float, lapses: FloatArray, log_size: FloatArray, seen: BoolArray) -> FloatArray:
    """(lapses, n) of all blocks, for curves with their middles on an even grid (n,) that holds all sizes.

    A block counts as parts of two at its neighbours on the grid, so that the sums over the blocks are convolutions.
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
    """(n,) how many values there are at each place of an even grid, each shared between its neighbours in proportion."""
    place = (values - grid[0]) / (grid[1] - grid[0])
    below = np.floor(place).astype(int)
    part = place - below
    shared = np.bincount(below, 1 - part, len(grid)) + np.bincount(below + 1, part, len(grid))
    return np.asarray(shared, dtype=np.float64)  # without values bincount gives integers


def _metres(logarithm: float) -> float | None:
    return float(np.exp(logarithm)) if np.isfinite(logarithm) else None
