"""Find the pixels that did not change, on which registration and noise are then measured.

Noise has both signs everywhere. Where rock is missing or was added, the differences have one sign over an area. So the scatter of
means over squares is taken from the quieter sign, to which changes of the other one do not contribute. A square whose mean lies
far beyond it has changed. Most walls lose rock in many places and gain hardly any: this then works even with little stable rock.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pipeline.monitoring.raster_statistics import dilated, mean_over_squares, quantiles

_SQUARES_PX = (3, 5, 9)
"""Sides of the squares over which means are taken: more than the 3 pixels that share points."""
_CHANGED = 4.0
"""Standard deviations of a mean over a square beyond which it has changed."""
_GROWS = 1.5
"""Standard deviations of a mean over 3 x 3 pixels to which a changed place reaches, along pixels of its sign."""
_QUANTILES = (0.25, 0.5, 0.9, 0.99)
_LONGEST_TAIL = 2.0
"""Times a normal distribution of the same first quartile that a quantile of noise may reach: what is farther out changed."""
_MARGIN_PX = 2
_ROUNDS, _SETTLED = 6, 1e-4
"""Most rounds of the search, and share of the pixels below which a change ends it."""
_SAMPLE = 100_000
"""Pixels of which scatter is measured. The standard deviation of the 0.99 quantile of one sign is then about 1 %."""
_FILLED = 0.5
_FEWEST = 50
"""Pixels of one sign without which its scatter is not known."""


def unchanged_pixels(standard: NDArray[np.floating], candidates: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pixels of a difference map where the wall did not change, on which registration and noise are then measured.

    Noise has both signs everywhere. A place has changed where differences of mainly one sign fill an area.

    Parameters
    ----------
    standard : (h, w) array
        Height differences divided by their predicted standard deviation, with mean zero where nothing changed; NaN without data.
    candidates : (h, w) bool
        Pixels that may be stable: all with data, or those in the stable areas that the user gave.

    Returns
    -------
    (h, w) bool
        The unchanged pixels.
    """
    candidates = candidates & np.isfinite(standard)
    unchanged = candidates
    means = {side: _mean_over_squares(standard, side) for side in _SQUARES_PX}
    for _ in range(_ROUNDS):
        before = unchanged
        unchanged = candidates & ~dilated(_changed(means, unchanged), _MARGIN_PX)
        if np.count_nonzero(unchanged) < _FEWEST:
            return before
        if np.count_nonzero(before != unchanged) <= _SETTLED * before.size:
            break
    return np.asarray(unchanged)


def quieter_scatter(values: NDArray[np.floating]) -> float:
    """Estimate the standard deviation of noise about zero where some of the differences are changes of mainly one sign.

    It is computed from the positive or from the negative values, whichever scatter less, and allows for long tails.

    values: (n,) differences, in any unit, which the result has too. Without values it is infinite.
    """
    sides = [side for side in (values[values > 0], -values[values < 0]) if len(side) >= _FEWEST]
    if not sides:
        return float(np.sqrt(np.mean(values**2))) if len(values) else np.inf
    normal = ndtri((1 + np.array(_QUANTILES)) / 2)
    found = [quantiles(side, _QUANTILES) / normal for side in sides]
    return float(min(min(each.max(), _LONGEST_TAIL * each[0]) for each in found))


def _changed(means: dict[int, NDArray[np.float32]], unchanged: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) changed places by the noise of the pixels that are unchanged as far as is known."""
    places = np.flatnonzero(unchanged)
    places = places[:: max(len(places) // _SAMPLE, 1)]
    scatter = {side: _scatter(mean.ravel()[places]) for side, mean in means.items()}
    changed = np.zeros(unchanged.shape, dtype=bool)
    for sign in (1.0, -1.0):
        begun = np.zeros(unchanged.shape, dtype=bool)
        for side in _SQUARES_PX:
            begun |= _beyond(means[side], _CHANGED * scatter[side], sign)
        if not begun.any():
            continue
        reached = _beyond(means[3], _GROWS * scatter[3], sign) | begun
        changed |= _connected_with(begun, reached)
    return changed


def _beyond(means: NDArray[np.float32], limit: float, sign: float) -> NDArray[np.bool_]:
    """(h, w) where means of one sign, 1 or -1, are farther from zero than a limit; NaN is not."""
    return np.asarray(means > np.float32(limit) if sign > 0 else means < np.float32(-limit))


def _connected_with(begun: NDArray[np.bool_], reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) connected parts of `reached` that contain a pixel of `begun`, all of which are in `reached`."""
    count, labels = cv2.connectedComponents(reached.view(np.uint8), connectivity=4)
    wanted = np.zeros(count, dtype=bool)
    wanted[labels[begun]] = True
    return np.asarray(wanted[labels])


def _scatter(means: NDArray[np.float32]) -> float:
    """Scatter of means on pixels that are unchanged; NaN is left out."""
    return quieter_scatter(means[np.isfinite(means)])


def _mean_over_squares(standard: NDArray[np.floating], side: int) -> NDArray[np.float32]:
    """(h, w) means over squares about each pixel; NaN where less than half of the square has data."""
    known = np.isfinite(standard)
    share = mean_over_squares(known.astype(np.float32), side)
    total = mean_over_squares(np.where(known, standard, 0.0).astype(np.float32), side)
    return np.where(known & (share > _FILLED), total / np.maximum(share, 1e-9), np.nan)
