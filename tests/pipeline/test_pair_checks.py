"""Checks of a camera pair and of the points that it is said to have seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.formats.measurements.checks import check_seen
from scene.common.errors import InputError
from sensors.cameras.camera import Camera, CameraPair

LEFT = Camera(1000, 800, 1000.0, *[0.0] * 10, position=np.zeros(3), rotation=np.eye(3))
PAIR = CameraPair(LEFT, replace(LEFT, position=np.array([1.0, 0.0, 0.0])))


def test_the_share_that_both_see() -> None:
    """At a depth of 10 m the left frame covers x from -5 to 5 m, the right one from -4 to 6 m: both see -4 to 5 m."""
    x = np.linspace(-10, 10, 20_001)
    points = np.stack([x, np.zeros_like(x), np.full_like(x, 10.0)], axis=1)
    assert check_seen(PAIR, points, "points") == pytest.approx(9 / 20, abs=1e-3)


@pytest.mark.parametrize(
    ("pair", "move", "words"),
    [
        (CameraPair(LEFT, LEFT), [0, 0, 10], "stand 0 m apart"),
        (PAIR, [0, 0, -10], "lie behind a camera"),
        (PAIR, [1000, 0, 10], "both cameras see 0 %"),
    ],
)
def test_a_pair_that_cannot_have_seen_them(pair: CameraPair, move: list[float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_seen(pair, np.random.default_rng(1).uniform(-1, 1, (100, 3)) + move, "points")
