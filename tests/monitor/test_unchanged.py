"""Which pixels did not change, and the noise and the registration that are measured on them."""

from __future__ import annotations

import numpy as np
import pytest
from monitor_cases import HEIGHT_M, WIDTH_M, depth
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.monitoring.alignment import RasterPair, refine
from pipeline.monitoring.gridding import gridded
from pipeline.monitoring.significance import significance
from pipeline.monitoring.unchanged import unchanged_pixels
from pipeline.registration.rigid import RigidTransform
from scene.geometry.grid import Grid

SHAPE = (200, 320)
EVERYWHERE = np.ones(SHAPE, dtype=bool)


def noise(seed: int) -> NDArray[np.float64]:
    """Noise of unit variance that is shared by 3 x 3 pixels, (h, w)."""
    white = np.random.default_rng(seed).normal(size=SHAPE)
    return np.asarray(3.0 * ndimage.uniform_filter(white, 3, mode="wrap"))


def patches(side: int, apart: int) -> NDArray[np.bool_]:
    """(h, w) squares on a regular grid."""
    row, column = np.indices(SHAPE) % apart
    return np.asarray((row < side) & (column < side))


def test_noise_alone_is_unchanged() -> None:
    found = unchanged_pixels(noise(1), EVERYWHERE)
    assert found.mean() > 0.98


@pytest.mark.parametrize("both_signs", [False, True])
def test_noise_is_measured_where_most_of_the_wall_changed(both_signs: bool) -> None:
    """Half of the wall lost 0.05 to 1 m, or every other patch gained it: the level of 10 mm of noise is right within 15 %."""
    random = np.random.default_rng(2)
    fallen = patches(28, 40)
    deep = ndimage.zoom(random.uniform(0.05, 1.0, (5, 8)), 40, order=0)
    sign = ndimage.zoom(np.where(np.indices((5, 8)).sum(axis=0) % 2, 1.0, -1.0), 40, order=0) if both_signs else 1.0
    difference = (0.010 * noise(3) + np.where(fallen, sign * deep, 0.0)).astype(np.float32)
    predicted = np.full(SHAPE, 0.008, dtype=np.float32)
    stable = unchanged_pixels(difference / predicted, EVERYWHERE)
    assert not stable[fallen].any()
    level = np.median(significance(difference, predicted, stable).level)
    assert level == pytest.approx(1.96 * 0.010, rel=0.15)


def test_the_registration_is_as_uncertain_as_it_says() -> None:
    """Ten epochs, a third of the wall missing in patches: errors over their standard deviations scatter by 1.0, within 40 %."""
    random = np.random.default_rng(4)
    grid = Grid(0.0, HEIGHT_M, 0.1, int(WIDTH_M / 0.1), int(HEIGHT_M / 0.1))

    def wall(fallen: bool) -> NDArray[np.float64]:
        x, y = random.uniform([0, 0], [WIDTH_M, HEIGHT_M], (100_000, 2)).T
        missing = fallen & (x % 3.0 < 1.8) & (y % 3.0 < 1.8)
        return np.column_stack([x, y, depth(x, y) - 0.1 * missing + 0.004 * random.normal(size=len(x))])

    errors = []
    for _ in range(10):
        found = refine([RasterPair(gridded(wall(False), grid), gridded(wall(True), grid))], None)
        shift = found.transform.apply(found.centre) - found.centre
        errors.append(np.concatenate([shift, found.transform.rotation_vector]) / np.sqrt(np.diag(found.covariance)))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.4)
    assert np.abs(np.mean(errors, axis=0)).max() < 1.3


def test_a_motion_beside_many_rockfalls_is_found() -> None:
    """Changes of one sign on a third of the wall do not draw the registration: within 0.5 mm where they average 33 mm."""
    random = np.random.default_rng(5)
    grid = Grid(0.0, HEIGHT_M, 0.1, int(WIDTH_M / 0.1), int(HEIGHT_M / 0.1))
    motion = RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.006]))
    x, y = random.uniform([0, 0], [WIDTH_M, HEIGHT_M], (100_000, 2)).T
    fallen = 0.015 * ((x % 3.0 < 1.8) & (y % 3.0 < 1.8))
    before, after = (np.column_stack([x, y, depth(x, y) - z + 0.004 * random.normal(size=len(x))]) for z in (0.0, fallen))
    found = refine([RasterPair(gridded(before, grid), gridded(motion.inverse().apply(after), grid))], None)
    assert (found.transform.apply(found.centre) - found.centre)[2] == pytest.approx(0.006, abs=5e-4)
