"""Smooth matching noise, as semi-global matching makes it."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from scene.upload import on_device
from sensors.effects.base import Effect, Stage, parameter
from sensors.matches import Matches


class RegularizationNoise(Effect):
    """Gaussian values on the nodes of a grid over the image, interpolated bilinearly (thesis 3.4).

    dd(u, v) = sum_ij w_ij(u, v) g_ij, g_ij ~ N(0, sigma), nodes at multiples of the step. Midway between nodes the variance is
    sigma^2 / 4 (bilinear), over the whole image 4 sigma^2 / 9 on average.
    """

    name: Literal["regularization_noise"] = "regularization_noise"
    sensor = "stereo"
    stage = Stage.MATCH
    order = 30
    sigma_px: float = parameter("standard deviation at the nodes", unit="px", source="empirical", typical=0.2, ge=0, le=1000)
    step_px: float = parameter("distance of the nodes", unit="px", source="empirical", null=None, default=32.0, gt=0)

    def evaluate(self, state: Matches, random: KeyedRandom) -> Matches:
        columns, rows = (int(np.ceil(size / self.step_px)) + 1 for size in (state.width, state.height))
        nodes = on_device(mi.Float32, random.generator().normal(0.0, self.sigma_px, (rows, columns)))
        step = dr.opaque(mi.Float64, self.step_px)
        x, y = state.u / step, state.v / step
        left, top = mi.UInt32(x), mi.UInt32(y)
        right_share, bottom_share = mi.Float32(x - left), mi.Float32(y - top)
        stride = dr.opaque(mi.UInt32, columns)
        corner = top * stride + left

        def node(offset: mi.UInt32) -> mi.Float32:
            return dr.gather(mi.Float32, nodes, corner + offset, state.matched)

        upper = dr.lerp(node(mi.UInt32(0)), node(mi.UInt32(1)), right_share)
        lower = dr.lerp(node(stride), node(stride + 1), right_share)
        return replace(state, disparity=state.disparity + mi.Float64(dr.lerp(upper, lower, bottom_share)))
