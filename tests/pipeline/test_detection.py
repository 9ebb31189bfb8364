"""Level of detection, detected blocks, false alarms and detection curves, against planted noise and known blocks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.comparison.detection import (
    BlockMeanTest,
    detect_blocks,
    false_alarms,
    footprints,
    level_of_detection,
    wilson_interval,
)
from pipeline.noise.variogram import Structure, VariogramModel
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

SIGMA = 0.01
WHITE = VariogramModel(SIGMA**2, ())


def noise(seed: int, shape: tuple[int, ...]) -> FloatArray:
    return KeyedRandom(seed).generator().normal(0, SIGMA, shape)


def record(label: int, side: float) -> dict[str, Any]:
    return {"label": label, "size_m": [side, side, side], "volume_m3": side**3 / 2}


def test_the_level_is_the_95_percent_quantile_where_it_lies() -> None:
    """5 epochs of cells of 40 x 40 pixels: the quantile of 8,000 values has a relative standard error of 1.1 %; the limit is
    four.
    """
    stable = noise(1, (5, 100, 120))
    stable[:, :, 80:] *= 3
    stable[:, :40, :40] = np.nan
    level = level_of_detection(stable, 40)
    assert level[90, 10] == pytest.approx(1.96 * SIGMA, rel=0.08)  # the lowest cells are half as high
    assert level[50, 50] == pytest.approx(1.96 * SIGMA, rel=0.05)
    assert level[50, 100] == pytest.approx(3 * 1.96 * SIGMA, rel=0.05)
    assert np.isfinite(level[0, 0])  # no data there: the median cell's
    assert np.isnan(level_of_detection(np.full((1, 10, 10), np.nan), 5)).all()


def test_the_limit_of_a_mean_follows_the_correlation() -> None:
    """For white noise it is z sigma / sqrt(n); for noise that is constant over the block z sigma, for any number of pixels."""
    level = np.full((50, 50), 1.96 * SIGMA, dtype=np.float32)
    block, window = np.ones((10, 10), dtype=bool), (slice(5, 15), slice(5, 15))
    assert BlockMeanTest(WHITE, level, 0.1).limit_m(block, window) == pytest.approx(1.96 * SIGMA / 10)
    alike = VariogramModel(0.0, (Structure("gaussian", SIGMA**2, 1e5),))
    assert BlockMeanTest(alike, level, 0.1).limit_m(block, window) == pytest.approx(1.96 * SIGMA, rel=1e-4)


def test_blocks_that_must_and_must_not_be_seen() -> None:
    change = noise(2, (60, 60))
    block, truth = np.zeros((60, 60), dtype=np.int32), np.zeros((60, 60))
    for label, (row, depth) in enumerate([(5, 0.1), (25, 0.0005), (45, 0.1)], start=1):
        block[row : row + 10, 20:30] = label
        truth[row : row + 10, 20:30] = depth
    change = change + truth
    change[45:55, 20:27] = np.nan  # hides 70 % of the third
    visible = np.ones((60, 60), dtype=bool)
    visible[45:55] = False
    test = BlockMeanTest(WHITE, np.full((60, 60), 1.96 * SIGMA, dtype=np.float32), 0.1)
    records = [record(1, 1.0), record(2, 1.0), record(3, 1.0), record(4, 0.1)]
    deep, shallow, hidden, absent = detect_blocks(1, change, block, truth, records, visible, test)
    assert (deep.seen, shallow.seen, hidden.seen, absent.seen) == (True, False, False, False)
    assert (deep.in_view, hidden.in_view, absent.in_view) == (True, False, False)
    assert deep.footprint_px == 100
    assert deep.size_m == pytest.approx(1.0)
    assert deep.depth_m == pytest.approx(0.1)
    assert deep.mean_m == pytest.approx(0.1, abs=4 * SIGMA / 10)
    assert deep.measured_volume_m3 == pytest.approx(0.1, abs=4 * SIGMA * 0.1)  # depth times 1 m2
    assert hidden.data_share == pytest.approx(0.3)
    assert hidden.mean_m is None


def test_stable_ground_is_taken_for_a_block_in_two_and_a_half_percent() -> None:
    """40 footprints at 10 places on each of 20 maps of white noise: 8,000 trials, 2.5 +- 0.18 %; the limit is 4.5 sigma."""
    level = np.full((200, 200), 1.96 * SIGMA, dtype=np.float32)
    test, random = BlockMeanTest(WHITE, level, 0.1), KeyedRandom(3)
    shapes = [np.ones((size, size), dtype=bool) for size in (4, 5, 6, 7)] * 10
    found = [false_alarms(noise(100 + number, (200, 200)), shapes, test, random.child(number)) for number in range(20)]
    alarms, trials = np.sum(found, axis=0)
    assert trials == 8000
    assert alarms / trials == pytest.approx(0.025, abs=0.0085)


def test_footprints_leave_out_what_did_not_recede() -> None:
    block = np.zeros((5, 5), dtype=np.int32)
    block[1:3, 1:4] = 2
    change = np.where(block == 2, 0.1, 0.0)
    change[1, 1] = 0.0
    ((label, window, footprint),) = footprints(block, change)
    assert (label, window) == (2, (slice(1, 3), slice(1, 4)))
    assert footprint.tolist() == [[False, True, True], [True, True, True]]


def test_wilsons_interval() -> None:
    """Against the published example of 81 of 263 (Newcombe 1998, table I): 0.2553 to 0.3662."""
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0, 0) == (0.0, 1.0)
