"""Grid-correlated matching noise with heavy tails, as textured and bare rock in one image give it."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import parameter
from sensors.effects.matching_noise import NodeNoise
from sensors.signal_chain.matches import Matches
from sensors.signal_chain.node_grid import smooth_field, uniform_field_correlation


class HeavyTailedNoise(NodeNoise):
    """Matching noise whose size varies log-normally over the image.

    dd = sigma a exp(t b - t^2), where a and b are independent smooth random fields of variance 1 and t is the tail parameter.
    The standard deviation is sigma, the kurtosis 3 exp(4 t^2). Both fields have Gaussian values on a grid of nodes `step`
    apart, with bilinear interpolation. The model was fitted to OpenCV's semi-global matching of rendered and real pictures
    (docs/explanation/matching.md). It is for simulation only; `scarpsim gap` does not look for it.
    """

    name: Literal["heavy_tailed_noise"] = "heavy_tailed_noise"
    means = "Most disparities are as good as the model says, some patches far worse: bare or repeated rock beside textured rock."
    act = (
        "Simulate and plan with the value found; judge change by each place's own level of detection, not by one for "
        "the whole wall."
    )
    order = 35
    catalogue = False
    sigma_px: float = parameter("standard deviation of the disparity", unit="px", source="empirical", typical=0.5, ge=0, le=1000)
    step_px: float = parameter("distance between nodes", unit="px", source="empirical", null=None, default=12.0, gt=0)
    tail: float = parameter(
        "standard deviation of the logarithm of the local noise level; 0: normal errors",
        unit="1",
        source="empirical",
        null=None,
        default=0.6,
        ge=0,
        le=2,
    )

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with smooth noise, px, added to the disparities; its local size itself varies smoothly.

        state: the matched cells of the depth map before this effect. random: source of random numbers.
        """
        error, size = (smooth_field(state, self.step_px, random.child(part), even=True) for part in ("error", "size"))
        sigma, tail = (dr.opaque(mi.Float32, value) for value in (self.sigma_px, self.tail))
        noise = sigma * error * dr.exp(tail * size - dr.square(tail))
        return replace(state, disparity=state.disparity + mi.Float64(noise))

    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """Return the semivariogram (k,), px2: half the mean squared difference of the errors of pixels that are `lag` apart.

        It is sigma^2 (1 - <r exp(t^2 (r - 1))>), where t is the tail parameter, r the correlation of the fields at two
        positions, and < > the average over positions. This follows from E exp(t (b + b')) = exp(t^2 (1 + r)) for normal b, b'
        of variance 1.

        lag: (k, 2) columns and rows from one pixel to the other, px.
        """
        correlation = uniform_field_correlation(lag / self.step_px)
        kept = correlation * np.exp(self.tail**2 * (correlation - 1))
        return np.asarray(self.sigma_px**2 * (1 - kept.mean(axis=1)))
