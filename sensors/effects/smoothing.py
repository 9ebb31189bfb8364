"""Smoothing: disparities are low-pass filtered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray
from sensors.effects.base import parameter
from sensors.effects.raster_effect import RasterEffect


class Smoothing(RasterEffect):
    """Disparities are low-pass filtered, as by the matcher's windows and smoothness terms.

    d' = (G * m d) / (G * m), where G is a Gaussian of standard deviation sigma, m is 1 where there is a match (else 0), and *
    is the convolution over the image. Unmatched cells neither count nor are filled (normalised convolution, Knutsson & Westin
    1993). Near them and at the image's border the mean is one-sided: where the disparity changes by s px per px, it is wrong by
    up to 0.8 s sigma.
    """

    name: Literal["smoothing"] = "smoothing"
    means = "Disparities are low-pass filtered: small blocks are flattened and lose volume."
    act = "Lower the matcher's smoothing or its depth filtering; blocks smaller than the length found are not measured."
    order = 20
    held_out_gain = 5.0  # slight smoothing also compensates for small errors of the assumed rays
    sigma_px: float = parameter("standard deviation of the low-pass", unit="px", source="empirical", typical=8.0, ge=0, le=500)

    @classmethod
    def scored(cls) -> bool:
        """Return whether `scarpsim gap` can judge the effect by a log score of residuals: True.

        Smoothing changes disparities on every curved part of the surface, not only at edges.
        """
        return True

    def filtered(self, disparity: FloatArray, cell_px: float, jump_px: float) -> FloatArray:
        """Return the disparities, px, after the Gaussian low-pass.

        disparity: (rows, columns) of the depth map, px, NaN without a match. cell_px: px of the full-resolution frame for each
        cell. jump_px: smallest difference of neighbours that is a depth step, px; not used.
        """
        return smoothed(disparity, self.sigma_px / cell_px)


@dataclass(frozen=True)
class LowPass:
    """A Gaussian low-pass filter for depth maps that have matches in the same cells; it averages over matched cells alone.

    Attributes
    ----------
    matched : (rows, columns) bool array
        Cells with a match.
    weight : (rows, columns) array
        `matched` (1 or 0) after the low-pass, by which filtered values are divided.
    sigma : float
        Standard deviation of the Gaussian, cells.
    """

    matched: NDArray[np.bool_]
    weight: FloatArray
    sigma: float

    @classmethod
    def over(cls, matched: NDArray[np.bool_], sigma: float) -> LowPass:
        """Prepare the low-pass filter for depth maps with given matches.

        matched: (rows, columns) mask of the cells with a match. sigma: standard deviation of the Gaussian, cells.
        """
        return cls(matched, _gaussian(matched.astype(np.float64), sigma), sigma)

    def of(self, disparity: FloatArray) -> FloatArray:
        """Return the values of a depth map after the low-pass, (rows, columns), NaN without a match.

        disparity: (rows, columns) values, in any unit, with matches where the filter was prepared for them.
        """
        total = _gaussian(np.where(self.matched, disparity, 0.0), self.sigma)
        return np.divide(total, self.weight, out=np.full_like(total, np.nan), where=self.matched)


def smoothed(disparity: FloatArray, sigma: float) -> FloatArray:
    """Return disparities (rows, columns), px, after a Gaussian low-pass over the matched cells; NaN stays where unmatched.

    disparity: (rows, columns), px, NaN where unmatched. sigma: standard deviation of the Gaussian, cells.
    """
    return LowPass.over(~np.isnan(disparity), sigma).of(disparity)


def _gaussian(values: FloatArray, sigma: float) -> FloatArray:
    """Filter with a Gaussian; values beyond the border are 0."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(values, sigma, mode="constant"))
