"""Low-pass filtering of the disparities."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from sensors.effects.base import Effect, Stage, parameter
from sensors.matches import Matches


class Smoothing(Effect):
    """d = (G * m d) / (G * m), G Gaussian with sigma px, m 1 where there is a match: the matcher's windows and smoothness terms.

    Unmatched cells neither count nor fill (normalised convolution, Knutsson & Westin 1993). Near them and at the frame's border
    the mean is over one side, so a slope s is off by up to 0.8 s sigma there.
    """

    name: Literal["smoothing"] = "smoothing"
    sensor = "stereo"
    stage = Stage.MATCH
    order = 20
    sigma_px: float = parameter("standard deviation of the low-pass", unit="px", source="empirical", typical=8.0, ge=0, le=500)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        return state.with_raster(smoothed(state.raster(), self.sigma_px / state.reduction))


def smoothed(disparity: FloatArray, sigma: float) -> FloatArray:
    """(rows, columns) disparities, px, NaN where unmatched, low-passed with `sigma` cells over the matched ones."""
    from scipy.ndimage import gaussian_filter

    matched = ~np.isnan(disparity)
    total = gaussian_filter(np.where(matched, disparity, 0.0), sigma, mode="constant")
    weight = gaussian_filter(matched.astype(np.float64), sigma, mode="constant")
    return np.divide(total, weight, out=np.full_like(total, np.nan), where=matched)
