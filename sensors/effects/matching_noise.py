"""What noise of the matching is: it makes disparities scatter, each by itself or together with its neighbours."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter


class MatchingNoise(Effect):
    """Noise of the disparity, of which the semivariogram is known in closed form."""

    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.SPREAD
    planned = True

    @abstractmethod
    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """(k,) half the mean squared difference of two pixels `lag` ((k, 2), px, columns and rows) apart, px2."""

    @property
    def total_variance(self) -> float:
        """Variance of a disparity on average over the image, px2: what the semivariogram tends to."""
        far = np.array([[1e9, 1e9]])
        return float(self.semivariogram(far)[0])

    def covariance(self, lag: FloatArray) -> FloatArray:
        """(k,) of two pixels `lag` ((k, 2), px) apart, px2."""
        return self.total_variance - self.semivariogram(lag)

    def variance(self, at: Any) -> FloatArray:
        return np.full(len(at), self.total_variance)


class NodeNoise(MatchingNoise):
    """Noise that neighbours share: random numbers on the nodes of a grid, interpolated."""

    shared = True
    step_px: float = parameter("distance of the nodes", unit="px", source="empirical", null=None, default=32.0, gt=0)
