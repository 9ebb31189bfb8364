"""White matching noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects.base import parameter
from sensors.effects.matching_noise import MatchingNoise
from sensors.signal_chain.matches import Matches


class ParallaxNoise(MatchingNoise):
    """Disparities have white noise: the error dd ~ N(0, sigma) is independent for each cell of the depth map."""

    name: Literal["parallax_noise"] = "parallax_noise"
    means = "Disparities scatter more than the model says, pixel by pixel."
    act = "Simulate and plan with the value found; sharper pictures, a lower ISO or a longer base lower it."
    order = 40
    sigma_px: float = parameter("standard deviation of the disparity", unit="px", source="empirical", typical=0.3, ge=0, le=1000)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with normal noise, px, added to each disparity, independently for each cell.

        state: the matched cells of the depth map before this effect. random: source of random numbers.
        """
        noise = mi.Float64(random.normals(state.index).x)
        return replace(state, disparity=state.disparity + dr.opaque(mi.Float64, self.sigma_px) * noise)

    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """Return the semivariogram (k,), px2: half the mean squared difference of the errors of pixels that are `lag` apart.

        It is sigma^2 for any lag, because different cells of the depth map are independent.

        lag: (k, 2) columns and rows from one pixel to the other, px.
        """
        return np.full(len(lag), self.sigma_px**2)
