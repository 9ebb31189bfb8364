"""Define the base classes of matching noise, which makes disparities scatter independently or together with their neighbours."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter


class MatchingNoise(Effect):
    """Noise of the disparity whose semivariogram is known in closed form."""

    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.SPREAD
    planned = True

    @abstractmethod
    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """Return half the mean squared difference (k,) of two pixels `lag` (k, 2) apart, px2; lag in px, columns and rows."""

    @property
    def total_variance(self) -> float:
        """Mean variance of a disparity over the image, px2: the limit of the semivariogram at large lags."""
        far = np.array([[1e9, 1e9]])
        return float(self.semivariogram(far)[0])

    def covariance(self, lag: FloatArray) -> FloatArray:
        """Return the covariance (k,) of two pixels `lag` (k, 2), px, apart, px2."""
        return self.total_variance - self.semivariogram(lag)

    def variance(self, at: Any) -> FloatArray:
        """Return the variance of a disparity, px2, the same for all pixels (n,)."""
        return np.full(len(at), self.total_variance)


class NodeNoise(MatchingNoise):
    """Grid-correlated noise: random numbers on the nodes of a grid, interpolated between them."""

    shared = True
    step_px: float = parameter("distance between nodes", unit="px", source="empirical", null=None, default=32.0, gt=0)
