"""Define the base classes of matching noise, which makes disparities scatter independently or together with their neighbours."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from scene.geometry.mesh import FloatArray
from sensors.effects.base import Effect, ShowsIn, Stage, parameter


class MatchingNoise(Effect):
    """Base class of noise of the disparity whose semivariogram (half the mean squared difference of two pixels) is known."""

    sensor = "stereo"
    stage = Stage.MATCH
    shows_in = ShowsIn.SPREAD
    planned = True

    @abstractmethod
    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """Return the semivariogram (k,), px2: half the mean squared difference of the errors of pixels that are `lag` apart.

        lag: (k, 2) columns and rows from one pixel to the other, px.
        """

    @property
    def total_variance(self) -> float:
        """Variance of the disparity that this noise causes, averaged over the image, px2.

        It is the limit of the semivariogram at large lags.
        """
        far = np.array([[1e9, 1e9]])
        return float(self.semivariogram(far)[0])

    def covariance(self, lag: FloatArray) -> FloatArray:
        """Return the covariance (k,), px2, of the errors of two pixels that are `lag` apart.

        lag: (k, 2) columns and rows from one pixel to the other, px.
        """
        return self.total_variance - self.semivariogram(lag)

    def variance(self, at: Any) -> FloatArray:
        """Return the variance of the disparity that this noise causes, px2, the same for all pixels (n,).

        at: geometry of n matched pixels of the stereo pair, as NumPy arrays.
        """
        return np.full(len(at), self.total_variance)


class NodeNoise(MatchingNoise):
    """Base class of grid-correlated noise: random numbers on the nodes of a grid over the image, interpolated between them.

    `step_px` is the distance between nodes, in px of the full-resolution frame.
    """

    shared = True
    step_px: float = parameter("distance between nodes", unit="px", source="empirical", null=None, default=32.0, gt=0)
