"""Test bounding boxes of points."""

from __future__ import annotations

import numpy as np
import pytest

from scene.geometry.bounds import bounding_box


@pytest.mark.parametrize("count", [1, 255, 256, 257, 1000])
def test_the_box_is_that_of_the_columns(count: int) -> None:
    """The box of any number of points, also in a view of a larger array, is that of each column."""
    points = np.random.default_rng(count).normal(size=(count, 6))
    for each in (points[:, :3], np.ascontiguousarray(points[:, 3:])):
        np.testing.assert_array_equal(bounding_box(each), [each.min(axis=0), each.max(axis=0)])


def test_a_coordinate_that_is_no_number_shows_in_the_box() -> None:
    """One NaN or infinite coordinate shows in the box of its axis, as `finite` needs."""
    points = np.zeros((600, 3))
    points[3, 1], points[599, 2] = np.nan, np.inf
    box = bounding_box(points)
    assert np.isnan(box[:, 1]).all()
    assert box[1, 2] == np.inf
    assert not box[:, 0].any()
