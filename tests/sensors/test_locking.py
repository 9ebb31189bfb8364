"""Pixel locking in another rectification than the sensor's own."""

from __future__ import annotations

import numpy as np
import pytest

from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from sensors.effects.pixel_locking import PixelLocking
from sensors.signal_chain.matches import Matches

COUNT = 12


@pytest.mark.parametrize("tilt", [0.0, 0.05, -0.1])
def test_locking_counts_the_disparities_of_a_rectification_that_is_turned_about_the_base(tilt: float) -> None:
    """d' = d_inf + (d - d_inf) / (1 + y tan w), computed in NumPy; without rotation the effect uses its own disparities."""
    rng = np.random.default_rng(6)
    disparity, tangent, infinity = rng.uniform(40, 90, COUNT), rng.uniform(-0.3, 0.3, COUNT), -250.0
    zero, seen = dr.zeros(mi.Float64, COUNT), (dr.zeros(mi.Int32, COUNT), dr.zeros(mi.Float64, COUNT), None)
    matched = dr.full(mi.Bool, True, COUNT)
    state = Matches(
        dr.arange(mi.UInt32, COUNT), zero, zero, mi.Float64(disparity), matched, *seen, 16, 12, 4, mi.Float64(tangent), infinity
    )
    turned = infinity + (disparity - infinity) / (1 + np.tan(tilt) * tangent)
    expected = disparity + 0.3 * np.sin(2 * np.pi * turned / 1.5 + 0.4)
    effect = PixelLocking(amplitude_px=0.3, period_px=1.5, phase_rad=0.4, tilt_rad=tilt)
    np.testing.assert_allclose(np.array(effect.evaluate(state, KeyedRandom(1)).disparity), expected, atol=1e-9)
