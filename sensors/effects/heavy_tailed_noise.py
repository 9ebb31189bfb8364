"""Smooth matching noise with heavy tails, as textured and bare, flat and broken rock together give it."""

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
from sensors.signal_chain.node_grid import even_correlation, smooth_field


class HeavyTailedNoise(NodeNoise):
    """dd = sigma a exp(t b - t^2), a and b independent smooth fields over the image of mean 0 and variance 1.

    A normal error whose size varies log-normally from place to place: standard deviation sigma, kurtosis 3 exp(4 t^2). Both
    fields: Gaussian values on a grid of nodes `step` apart, bilinear. Not in the shared catalogue; drawn from OpenCV's
    semi-global matching of rendered and of real pictures (docs/explanation/matching.md).
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
    step_px: float = parameter("distance of the nodes", unit="px", source="empirical", null=None, default=12.0, gt=0)
    tail: float = parameter(
        "standard deviation of the size's logarithm; 0: normal errors",
        unit="1",
        source="empirical",
        null=None,
        default=0.6,
        ge=0,
        le=2,
    )

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        error, size = (smooth_field(state, self.step_px, random.child(part), even=True) for part in ("error", "size"))
        sigma, tail = (dr.opaque(mi.Float32, value) for value in (self.sigma_px, self.tail))
        noise = sigma * error * dr.exp(tail * size - dr.square(tail))
        return replace(state, disparity=state.disparity + mi.Float64(noise))

    def semivariogram(self, lag: FloatArray) -> FloatArray:
        """sigma^2 (1 - <r exp(t^2 (r - 1))>), r the correlation of the fields at two places, averaged over the places.

        From E exp(t (b + b')) = exp(t^2 (1 + r)) for normal b, b' of variance 1.
        """
        correlation = even_correlation(lag / self.step_px)
        kept = correlation * np.exp(self.tail**2 * (correlation - 1))
        return np.asarray(self.sigma_px**2 * (1 - kept.mean(axis=1)))
