"""Wall blocks are the same squares for every part of a measurement."""

from __future__ import annotations

import numpy as np

from pipeline.gap.residuals.wall_blocks import WallCells


def test_a_part_of_the_points_lies_in_the_same_blocks() -> None:
    """Half of a wall, whose lower left corner is another one, has the numbers that it has on the whole wall."""
    at = np.random.default_rng(3).uniform([-10.0, 2.0], [10.0, 14.0], (20_000, 2))
    blocks, part = WallCells.over(at).blocks, at[:, 0] > 0.7
    np.testing.assert_array_equal(blocks.numbers(at[part]), blocks.numbers(at)[part])
    np.testing.assert_array_equal(blocks.for_validation(at[part]), blocks.for_validation(at)[part])


def test_a_fifth_of_the_wall_is_kept_for_validation_in_whole_blocks() -> None:
    """Blocks have the stated side; the share of points kept is 20 % (tolerance 3 %, as blocks at the border are cut)."""
    at = np.random.default_rng(4).uniform([0.0, 0.0], [20.0, 12.0], (50_000, 2))
    blocks = WallCells.over(at).blocks
    number, kept = blocks.numbers(at), blocks.for_validation(at)
    for each in np.unique(number):
        inside = number == each
        assert np.all(np.ptp(at[inside], axis=0) <= blocks.side_m)
        assert len(np.unique(kept[inside])) == 1
    assert abs(kept.mean() - 0.2) < 0.03
