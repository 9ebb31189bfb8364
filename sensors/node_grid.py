"""Smooth random fields over the image: Gaussian values on the nodes of a grid, interpolated bilinearly."""

from __future__ import annotations

import numpy as np

from scene.backend import dr, mi
from scene.keyed_random import KeyedRandom
from scene.upload import on_device
from sensors.matches import Matches


def smooth_field(state: Matches, step_px: float, random: KeyedRandom, *, even: bool = False) -> mi.Float32:
    """(n,) the field at the cells of `state`: sum_ij w_ij(u, v) g_ij, g_ij ~ N(0, 1), nodes at multiples of `step_px`.

    Its variance is 1 at the nodes, 1/4 midway between them and 4/9 on average; even: divided by the root of sum w_ij^2, so that
    it is 1 everywhere.
    """
    columns, rows = (int(np.ceil(size / step_px)) + 1 for size in (state.width, state.height))
    nodes = on_device(mi.Float32, random.generator().standard_normal((rows, columns)))
    step = dr.opaque(mi.Float64, step_px)
    x, y = state.u / step, state.v / step
    left, top = mi.UInt32(x), mi.UInt32(y)
    across, down = mi.Float32(x - left), mi.Float32(y - top)
    stride = dr.opaque(mi.UInt32, columns)
    corner = top * stride + left
    a, b, c, d = (dr.gather(mi.Float32, nodes, corner + offset, state.matched) for offset in (0, 1, stride, stride + 1))
    field = dr.lerp(dr.lerp(a, b, across), dr.lerp(c, d, across), down)
    if not even:
        return field
    squares = (dr.square(share) + dr.square(1 - share) for share in (across, down))
    return field * dr.rsqrt(next(squares) * next(squares))
