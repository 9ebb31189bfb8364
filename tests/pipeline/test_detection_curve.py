"""The detection curve and the smallest detectable block, against known curves, and blocks that do not determine it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from pipeline.comparison.detection_curve import DetectionCurve, detection_curve
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray

MIDDLE, WIDTH = 0.1, 0.3


def fitted(size: FloatArray, seen: FloatArray) -> DetectionCurve:
    curve = detection_curve(np.asarray(size, dtype=np.float64), np.asarray(seen, dtype=bool))
    assert curve is not None
    estimate, (low, high) = curve.smallest_95_m, curve.interval_m
    assert estimate is None or (low or 0.0) <= estimate <= (high or np.inf)
    return curve


def drawn(seed: int, count: int, lapse: float, sizes: FloatArray | None = None) -> DetectionCurve:
    """Return blocks of all sizes, or of a few sizes with a spread of 10 %, detected at random by the known curve."""
    generator = KeyedRandom(seed).generator()
    size = np.exp(generator.uniform(np.log(0.03), np.log(0.6), count))
    if sizes is not None:
        size = np.resize(sizes, count) * np.exp(generator.normal(0, 0.1, count))
    chance = (1 - lapse) * ndtr(np.log(size / MIDDLE) / WIDTH)
    return fitted(size, generator.random(count) < chance)


def truth(lapse: float) -> float:
    return MIDDLE * float(np.exp(WIDTH * ndtri(0.95 / (1 - lapse))))


@pytest.mark.parametrize(
    ("count", "lapse", "sizes"),
    [(200, 0.0, None), (200, 0.02, None), (60, 0.02, np.geomspace(0.05, 0.8, 6)), (60, 0.0, [0.05, 0.4])],
)
def test_the_interval_holds_the_truth_as_often_as_it_says(count: int, lapse: float, sizes: FloatArray | None) -> None:
    """20 trials each: fewer than 16 of them contain the truth with probability 0.26 % per 95 % interval, 1 % for any of four."""
    inside = 0
    for seed in range(20):
        low, high = drawn(seed, count, lapse, sizes).interval_m
        inside += (low or 0.0) <= truth(lapse) <= (high or np.inf)
    assert inside >= 16


def test_many_blocks_tell_the_curve() -> None:
    """3,000 blocks without lapses give the size to about 4 %; the limit is four standard errors (false failure: 0.01 %)."""
    curve = drawn(7, 3000, 0.0)
    assert curve.smallest_95_m == pytest.approx(truth(0.0), rel=0.16)
    assert curve.middle_m == pytest.approx(MIDDLE, rel=0.06)
    low, high = curve.interval_m
    assert low is not None
    assert high is not None
    assert 1.02 < high / low < 1.5
    at = np.array([0.05, 0.1, 0.2])
    np.testing.assert_allclose(curve.probability(at), ndtr(np.log(at / MIDDLE) / WIDTH), atol=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_a_gap_between_the_sizes_is_told_and_no_number_made_up(seed: int) -> None:
    """Complete separation: all blocks of 5 cm are missed, all of 30 cm detected.

    The likelihood is 1 for any size between them, to a tenth, because the curve's least width of 0.02 keeps it away from the
    blocks themselves.
    """
    spread = np.exp(KeyedRandom(seed).generator().normal(0, 0.1, 60))
    size = np.repeat([0.05, 0.3], 30) * spread
    curve = fitted(size, np.repeat([False, True], 30))
    assert curve.smallest_95_m is None
    assert curve.between_m == pytest.approx((size[:30].max(), size[30:].min()))
    low, high = curve.interval_m
    assert low is not None
    assert low < 1.1 * size[:30].max()
    assert high is None or high > size[30:].min() / 1.1
    assert (curve.count, curve.seen) == (60, 30)


def test_separation_without_a_gap_has_its_number_between() -> None:
    """Sizes are 2 % apart: the estimate lies between the largest missed and the smallest detected block, to a grid step of
    2.5 %.
    """
    size = np.geomspace(0.05, 0.8, 141)
    curve = fitted(size, size > 0.2)
    assert curve.between_m is None
    assert curve.smallest_95_m == pytest.approx(0.2, rel=0.05)


def test_all_seen_is_smaller_than_the_smallest_and_none_seen_larger_than_the_largest() -> None:
    size = np.geomspace(0.05, 0.8, 80)
    everything, nothing = fitted(size, np.ones(80)), fitted(size, np.zeros(80))
    assert everything.smallest_95_m is nothing.smallest_95_m is None
    assert everything.between_m == pytest.approx((None, 0.05))
    assert nothing.between_m == pytest.approx((0.8, None))
    assert everything.interval_m[0] is None
    assert everything.interval_m[1] == pytest.approx(0.1, rel=0.9)
    assert nothing.interval_m[1] is None
    assert nothing.interval_m[0] == pytest.approx(0.75, rel=0.1)


@pytest.mark.parametrize(("seen", "between"), [(0, (0.1, None)), (15, (0.1, None)), (30, (None, 0.1))])
def test_one_size_tells_on_which_side_the_smallest_block_lies(seen: int, between: tuple[float | None, float | None]) -> None:
    curve = fitted(np.full(30, 0.1), np.arange(30) < seen)
    assert curve.smallest_95_m is None
    assert curve.between_m == pytest.approx(between)


def test_a_curve_that_stays_below_has_no_smallest_block() -> None:
    generator = KeyedRandom(5).generator()
    curve = fitted(np.geomspace(0.05, 1, 200), generator.random(200) < 0.7)
    assert curve.smallest_95_m is curve.between_m is curve.interval_m[1] is None
    assert curve.lapse == pytest.approx(0.3, abs=0.13)  # four standard errors of the share


def test_few_blocks_say_nothing() -> None:
    assert detection_curve(np.ones(9), np.ones(9, dtype=bool)) is None
