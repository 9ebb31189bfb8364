"""Grid-correlated matching noise, as the regularisation of semi-global matching causes it."""

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
from sensors.signal_chain.node_grid import node_semivariogram, smooth_field


class RegularizationNoise(NodeNoise):
    """Neighbouring disparities share errors: Gaussian values on the nodes of a grid over the image, interpolated bilinearly.

    dd(u, v) = sum_ij w_ij(u, v) g_ij, with a random value g_ij ~ N(0, sigma) at node (i, j). Nodes lie at multiples of `step`.
    The bilinear weights w_ij decrease from 1 at the node to 0 one step away. The variance is sigma^2 / 4 midway between nodes,
    and 4 sigma^2 / 9 on average over the image.
    """

    name: Literal["regularization_noise"] = "regularization_noise"
    means = "Disparities have errors that neighbours share, as a smoothing matcher makes them."
    act = (
        "Simulate and plan with the value found: averaging neighbours does not lower it. A matcher with less smoothing "
        "lowers it, and so does the mean of depth maps from several camera positions."
    )
    told_by = "disparities of every pixel, of which neighbours share this noise and no white one"
    order = 30
    sigma_px: float = parameter("standard deviation at the nodes", unit="px", source="empirical", typical=0.2, ge=0, le=1000)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        """Return the matches with grid-correlated noise, px, added to the disparities.

        state: the matched cells of the depth map before this effect. random: source of random numbers.
        """
        field = smooth_field(state, self.step_px, random)
        return replace(state, disparity=state.disparity + mi.Float64(dr.opaque(mi.Float32, self.sigma_px) * field))

    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """Return the semivariogram (k,), px2: half the mean squared difference of the errors of pixels that are `lag` apart.

        lag: (k, 2) columns and rows from one pixel to the other, px.
        """
        return np.asarray(self.sigma_px**2 * node_semivariogram(lag / self.step_px))
