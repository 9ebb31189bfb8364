"""Generate smooth random fields over the image: Gaussian values on the nodes of a grid, interpolated bilinearly.

The module also computes the fields' semivariogram and correlation in closed form.
"""

from __future__ import annotations

import numpy as np

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from scene.ray_casting.upload import on_device
from sensors.numerics.device import cell_index
from sensors.signal_chain.matches import Matches


def smooth_field(state: Matches, step_px: float, random: KeyedRandom, *, even: bool = False) -> mi.Float32:
    """Draw a smooth random field over the image and evaluate it at the cells of a depth map, (n,).

    It has independent standard normal values at the nodes of a grid, with bilinear interpolation between them.

    The variance is 1 at the nodes, 1/4 midway between them and 4/9 on average.

    Parameters
    ----------
    state : Matches
        The n cells of the depth map.
    step_px : float
        Distance between nodes, px; nodes lie at multiples of it.
    random : KeyedRandom
        Source of the node values.
    even : bool
        Whether to scale the field so that the variance is 1 everywhere, not only at the nodes.
    """
    columns, rows = (int(np.ceil(size / step_px)) + 1 for size in (state.width, state.height))
    nodes = on_device(mi.Float32, random.generator().standard_normal((rows, columns)))
    step = dr.opaque(mi.Float64, step_px)
    x, y = state.u / step, state.v / step
    left, top = cell_index(x, columns - 1), cell_index(y, rows - 1)
    across, down = mi.Float32(x - left), mi.Float32(y - top)
    stride = dr.opaque(mi.UInt32, columns)
    corner = top * stride + left
    a, b, c, d = (dr.gather(mi.Float32, nodes, corner + offset, state.matched) for offset in (0, 1, stride, stride + 1))
    field = dr.lerp(dr.lerp(a, b, across), dr.lerp(c, d, across), down)
    if not even:
        return field
    squares = (dr.square(share) + dr.square(1 - share) for share in (across, down))
    return field * dr.rsqrt(next(squares) * next(squares))


MEAN_VARIANCE = 4 / 9
"""Mean variance of a field whose nodes have variance 1."""
_PHASES = (np.arange(24) + 0.5) / 24
"""Positions within a cell of nodes over which averages are taken."""


def node_semivariogram(lag: FloatArray) -> FloatArray:
    """Compute the semivariogram (k,) of grid-correlated noise with variance 1 at its nodes, averaged over positions.

    The semivariogram is half the mean squared difference of two places. lag: (k, 2) distance of the places along both axes of
    the grid, in units of the distance between nodes. It is 4/9 - B(x) B(y) at the lag (x, y), where B is the cubic B-spline
    (2/3 at 0, 0 from 2 on), the convolution of two hat functions.
    """
    across, down = (_spline(np.abs(lag[:, axis])) for axis in (0, 1))
    return np.asarray(MEAN_VARIANCE - across * down)


def _spline(x: FloatArray) -> FloatArray:
    """Evaluate the cubic B-spline at x >= 0."""
    near, far = 2 / 3 - x**2 + x**3 / 2, np.maximum(2 - x, 0.0) ** 3 / 6
    return np.where(x < 1, near, far)


def uniform_field_correlation(lag: FloatArray) -> FloatArray:
    """Compute the correlation (k, m) of two places in grid-correlated noise that is scaled to the same variance everywhere.

    lag: (k, 2) distance of the places along both axes of the grid, in units of the distance between nodes. The correlation
    depends on the position between the nodes; it is evaluated for m positions.
    """
    across, down = (_along_axis(np.abs(lag[:, axis])) for axis in (0, 1))
    return np.asarray((across[:, :, None] * down[:, None, :]).reshape(len(lag), -1))


def _along_axis(lag: FloatArray) -> FloatArray:
    """Compute the correlation (k, positions) along one axis: which nodes two positions share, and with which weights."""
    here = _PHASES[None, :]
    ahead = here + np.minimum(lag, 4.0)[:, None]  # from a lag of 2 on no node is shared
    cells = np.floor(ahead)
    there = ahead - cells
    shared = np.select([cells == 0, cells == 1], [(1 - here) * (1 - there) + here * there, here * (1 - there)], 0.0)
    sizes = (np.sqrt((1 - share) ** 2 + share**2) for share in (here, there))
    return np.asarray(shared / (next(sizes) * next(sizes)))
