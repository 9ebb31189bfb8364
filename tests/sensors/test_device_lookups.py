"""Table lookups on the device at arbitrary places: a read outside the array would end the process."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.upload import on_device
from sensors.numerics.curve import Axis, interpolate, interpolate_on_host
from sensors.numerics.device import cell_index
from sensors.signal_chain.matches import Matches
from sensors.signal_chain.node_grid import smooth_field
from sensors.stereo.refinement import RefinementConfig, refine
from sensors.stereo.stereo_matched import sampled_disparity

ODD = np.array([np.nan, np.inf, -np.inf, -1.0, -1e-9, -1e300, 1e300, 4.0e9, 2.0**31, 2.0**32, -(2.0**40), 1e18])
"""Places at which a lookup must not read: not numbers, before the first cell, behind the last, beyond 32 bits."""
SIZES = (2, 3, 4096)


@pytest.mark.parametrize("kind", [mi.Float32, mi.Float64])
@pytest.mark.parametrize("count", [1, *SIZES])
def test_a_cell_index_stays_in_its_array(kind: type, count: int) -> None:
    inside = np.array([0.0, 0.5, count - 1.0, count - 0.5])
    index = cell_index(on_device(kind, np.concatenate([ODD, inside])), count).numpy()
    expected = np.where(np.nan_to_num(ODD) < 1, 0, count - 1)
    np.testing.assert_array_equal(index, [*expected, *np.floor(inside)])


@pytest.mark.parametrize("period", [0.0, 2.5])
@pytest.mark.parametrize("count", SIZES)
def test_a_curve_is_held_beyond_its_ends_and_nan_stays_nan(count: int, period: float) -> None:
    """Compared with the same lookup in NumPy on the host; huge places are left out for a periodic curve, where
    rounding decides.
    """
    axis = Axis(low=-1.0, high=3.0, period=period)
    values = (tuple(np.sin(np.arange(count))),)
    odd = ODD if not period else ODD[np.abs(np.nan_to_num(ODD)) < 1e9]
    x = np.concatenate([odd, [-1.0, 0.3, 2.9, 3.0]])
    on_the_device = interpolate(on_device(mi.Float64, x), mi.Float64(0.0), axis, Axis(), values).numpy()
    with np.errstate(invalid="ignore"):
        on_the_host = interpolate_on_host(x, np.zeros(len(x)), axis, Axis(), values)
    np.testing.assert_allclose(on_the_device, on_the_host, atol=1e-12)
    assert np.isnan(on_the_device[0])


def test_a_surface_is_held_beyond_its_corners() -> None:
    rows = ((0.0, 1.0, 2.0), (10.0, 11.0, 12.0))
    pairs = np.array([(x, y) for x in ODD for y in ODD])
    found = interpolate(*(on_device(mi.Float64, column) for column in pairs.T), Axis(high=2.0), Axis(), rows).numpy()
    held = np.clip(pairs, 0.0, [2.0, 1.0])  # NaN stays NaN
    np.testing.assert_allclose(found, held[:, 0] + 10 * held[:, 1], atol=1e-12)


@pytest.mark.parametrize("even", [False, True])
def test_a_field_on_nodes_can_be_asked_for_places_outside_the_image(even: bool) -> None:
    """Inside the image the values are those of bilinear interpolation; outside no value is defined, but nothing is read there."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.concatenate([ODD, [10.0]]), np.concatenate([ODD, [7.0]])))
    field = smooth_field(_matches(u, v), 8.0, KeyedRandom(1), even=even).numpy()
    expected = smooth_field(_matches(np.array([10.0]), np.array([7.0])), 8.0, KeyedRandom(1), even=even).numpy()
    assert field[-1] == expected[0]
    corner = smooth_field(_matches(np.array([64.0]), np.array([48.0])), 8.0, KeyedRandom(1)).numpy()[0]
    assert corner == np.float32(KeyedRandom(1).generator().standard_normal((7, 9))[-1, -1])


def test_a_disparity_map_has_no_value_outside() -> None:
    disparity = np.arange(12, dtype=np.float32).reshape(3, 4) / 100
    column, row = (grid.ravel() for grid in np.meshgrid(np.concatenate([ODD, [1.5]]), np.concatenate([ODD, [0.5]])))
    found = sampled_disparity(disparity, on_device(mi.Float64, column), on_device(mi.Float64, row)).numpy()
    assert np.isnan(found[:-1]).all()
    assert found[-1] == pytest.approx((0.01 + 0.02 + 0.05 + 0.06) / 4)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1e9, 1e9, 2.0**31])
def test_refinement_leaves_a_disparity_that_points_out_of_the_picture(value: float) -> None:
    picture = np.random.default_rng(3).uniform(0, 255, (40, 60)).astype(np.uint8)
    disparity = np.full((40, 60), 2.0, dtype=np.float32)
    disparity[20, 30] = value
    found = refine(picture, np.roll(picture, -2, axis=1), disparity, RefinementConfig())
    assert not abs(found[20, 30]) < 1e6 or found[20, 30] == 2.0
    assert np.nanmedian(found) == pytest.approx(2.0, abs=1e-3)


def _matches(u: NDArray[np.float64], v: NDArray[np.float64]) -> Matches:
    """Return matches at these places of a frame of 64 x 48 px, all marked as matched."""
    n = len(u)
    zero, index = dr.zeros(mi.Float64, n), dr.arange(mi.UInt32, n)
    seen = dr.zeros(mi.Int32, n), zero, None
    found = Matches(index, zero, zero, zero, dr.full(mi.Bool, True, n), *seen, 64, 48, 4, zero, 0.0)
    return replace(found, u=on_device(mi.Float64, u), v=on_device(mi.Float64, v))
