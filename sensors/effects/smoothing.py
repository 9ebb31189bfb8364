"""Low-pass filtering of the disparities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray
from sensors.effects.base import parameter
from sensors.effects.raster_effect import RasterEffect


class Smoothing(RasterEffect):
    """d = (G * m d) / (G * m), G Gaussian with sigma px, m 1 where there is a match: the matcher's windows and smoothness terms.

    Unmatched cells neither count nor fill (normalised convolution, Knutsson & Westin 1993). Near them and at the frame's border
    the mean is over one side, so a slope s is off by up to 0.8 s sigma there.
    """

    name: Literal["smoothing"] = "smoothing"
    means = "Disparities are low-pass filtered: small blocks are flattened and lose volume."
    act = "Lower the matcher's smoothing or its depth filtering; blocks smaller than the length found are not measured."
    order = 20
    held_out_gain = 5.0  # a little low-pass also makes up for rays that are not quite where they are thought to be
    sigma_px: float = parameter("standard deviation of the low-pass", unit="px", source="empirical", typical=8.0, ge=0, le=500)

    @classmethod
    def scored(cls) -> bool:
        return True  # it moves disparities on every curved part of the surface, not at edges alone

    def filtered(self, disparity: FloatArray, cell_px: float, jump_px: float) -> FloatArray:
        return smoothed(disparity, self.sigma_px / cell_px)


@dataclass(frozen=True)
class LowPass:
    """Of rasters with a match in the same cells. matched: (rows, columns) those; weight: their own low-pass; sigma: cells."""

    matched: NDArray[np.bool_]
    weight: FloatArray
    sigma: float

    @classmethod
    def over(cls, matched: NDArray[np.bool_], sigma: float) -> LowPass:
        return cls(matched, _gaussian(matched.astype(np.float64), sigma), sigma)

    def of(self, disparity: FloatArray) -> FloatArray:
        """(rows, columns) low-passed values, NaN where there is no match."""
        total = _gaussian(np.where(self.matched, disparity, 0.0), self.sigma)
        return np.divide(total, self.weight, out=np.full_like(total, np.nan), where=self.matched)


def smoothed(disparity: FloatArray, sigma: float) -> FloatArray:
    """(rows, columns) disparities, px, NaN where unmatched, low-passed with `sigma` cells over the matched ones."""
    return LowPass.over(~np.isnan(disparity), sigma).of(disparity)


def _gaussian(values: FloatArray, sigma: float) -> FloatArray:
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(values, sigma, mode="constant"))
