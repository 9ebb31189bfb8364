"""Test the search tree against all distances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from pipeline.registration.search_tree import SearchTree


@pytest.mark.parametrize("order", ["sorted", "shuffled"])
@pytest.mark.parametrize("neighbours", [1, 2, 3])
@pytest.mark.parametrize("limit", [0.05, 0.4, np.inf])
@pytest.mark.parametrize("place", [0.2, 0.5, 3.0])
def test_the_nearest_points_of_both_halves_are_found(order: str, neighbours: int, limit: float, place: float) -> None:
    generator = np.random.default_rng(5)
    cloud = generator.uniform(0, 1, (501, 3))
    if order == "sorted":
        cloud = cloud[np.argsort(cloud[:, 0])]
    points = place + generator.uniform(-0.2, 0.2, (300, 3))
    distance, found = SearchTree(cloud).query(points, neighbours, limit)
    every = cdist(points, cloud)
    expected = np.argsort(every, axis=1)[:, :neighbours]
    nearest = np.take_along_axis(every, expected, axis=1)
    inside = nearest < limit
    np.testing.assert_array_equal(found, np.where(inside, expected, len(cloud)))
    np.testing.assert_allclose(distance, np.where(inside, nearest, np.inf), rtol=1e-14)


def test_no_points_are_searched() -> None:
    distance, found = SearchTree(np.random.default_rng(1).uniform(size=(10, 3))).query(np.empty((0, 3)), 2, 1.0)
    assert distance.shape == found.shape == (0, 2)
