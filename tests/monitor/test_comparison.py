"""Registration, level of detection and regions on walls whose motion and missing rock are known."""

from __future__ import annotations

import numpy as np
import pytest
from monitor_cases import HEIGHT_M, WIDTH_M, depth

from pipeline.monitoring.alignment import RasterPair, applied, refine
from pipeline.monitoring.comparison import ReferenceHeights, compare_epoch
from pipeline.monitoring.events import Catalogue, Change, find_regions
from pipeline.monitoring.gridding import WallPoints, gridded
from pipeline.monitoring.magnitude import fit_power_law
from pipeline.monitoring.significance import Significance, significance
from pipeline.monitoring.stable_areas import StableRock
from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

GRID = Grid(0.0, HEIGHT_M, 0.08, int(WIDTH_M / 0.08), int(HEIGHT_M / 0.08))
COUNT = 200_000


def wall(seed: int, noise_m: float = 0.003, missing: tuple[tuple[float, float, float, float], ...] = ()) -> FloatArray:
    """Points in the wall frame, m; missing: x, y, side and depth of cuboids."""
    random = np.random.default_rng(seed)
    x, y = random.uniform([0, 0], [WIDTH_M, HEIGHT_M], (COUNT, 2)).T
    z = depth(x, y)
    for at_x, at_y, side, deep in missing:
        z = np.where((np.abs(x - at_x) < side / 2) & (np.abs(y - at_y) < side / 2), z - deep, z)
    return np.column_stack([x, y, z + noise_m * random.normal(size=COUNT)])


def cloud(seed: int, missing: tuple[tuple[float, float, float, float], ...] = ()) -> WallPoints:
    """The same, as an epoch."""
    return WallPoints.of(wall(seed, missing=missing))


def test_a_motion_is_found_within_its_own_uncertainty() -> None:
    """What ICP leaves, 30 microradians and 1 mm, while a quarter of the wall moved by 0.2 m: errors below 4 sigma."""
    centre = np.array([WIDTH_M / 2, HEIGHT_M / 2, 0.0])
    motion = RigidTransform.about(centre, np.array([2e-5, -1e-5, 2e-5]), np.array([0.0004, -0.0006, 0.0010]))
    reference = gridded(wall(1), GRID)
    moved = wall(2)
    moved[moved[:, 0] < 4.0, 2] += 0.2
    found = refine([RasterPair(reference, gridded(motion.inverse().apply(moved), GRID))], None)
    sigma = np.sqrt(np.diag(found.covariance))
    shift = found.transform.apply(found.centre) - motion.apply(found.centre)
    turn = found.transform.rotation_vector - motion.rotation_vector
    assert (np.abs(np.concatenate([shift, turn])) < 4 * sigma + 1e-5).all()
    assert sigma[:3].max() < 1e-3
    assert found.rms_m == pytest.approx(np.sqrt(2) * 0.003 / np.sqrt(7), rel=0.6)
    assert not found.stable[0][:, :45].any()


@pytest.mark.parametrize("width", [2500, int(WIDTH_M / 0.08)])
def test_the_uncertainty_is_known_on_a_small_part_of_a_map(width: int) -> None:
    """Stray points make the map twelve times as wide as the wall; and the stable rock is a single box of 1 m."""
    grid = Grid(0.0, HEIGHT_M, 0.08, width, int(HEIGHT_M / 0.08))
    areas = None if width > 1000 else StableRock(((4.6, 4.6, 6.4, 6.4),), WallFrame(np.eye(3), np.zeros(3)))
    found = refine([RasterPair(gridded(wall(1), grid), gridded(wall(2), grid))], areas)
    assert np.isfinite(found.covariance).all()
    assert np.sqrt(np.diag(found.covariance))[:3].max() < (1e-3 if areas is None else 0.1)


def test_heights_are_moved_as_their_points_are() -> None:
    reference, points = gridded(wall(1), GRID), wall(2, 0.0)
    motion = RigidTransform.about(np.array([8.0, 5.0, 0.0]), np.array([1e-4, 2e-4, -1e-4]), np.array([1e-3, 2e-3, -4e-3]))
    epoch = gridded(points, GRID)
    pair = RasterPair(reference, gridded(motion.apply(points), GRID))
    alignment = refine([pair], None)
    np.testing.assert_allclose(
        applied(alignment, pair, pair.design(alignment.centre))[5:-5, 5:-5],
        epoch.height[5:-5, 5:-5],
        atol=2e-3,
    )


def test_five_percent_of_stable_rock_exceed_the_level() -> None:
    """Also where the noise is three times as large on one half: within 1.5 points on either."""
    random = np.random.default_rng(5)
    predicted = np.full((200, 300), 0.002, dtype=np.float32)
    predicted[:, 150:] = 0.006
    difference = (1.4 * predicted * random.normal(size=predicted.shape)).astype(np.float32)
    found = significance(difference, predicted, np.ones(predicted.shape, dtype=bool))
    beyond = np.abs(difference) > found.level
    assert beyond[:, :150].mean() == pytest.approx(0.05, abs=0.015)
    assert beyond[:, 150:].mean() == pytest.approx(0.05, abs=0.015)
    assert found.sigma_of_mean(25) == pytest.approx(1 / 5, rel=0.25)


def test_blocks_are_found_with_their_volumes_and_nothing_else() -> None:
    blocks = ((3.0, 3.0, 0.6, 0.15), (10.0, 6.0, 0.8, 0.08), (13.0, 2.5, 0.4, 0.3))
    found = compare_epoch(ReferenceHeights.of(cloud(1), [GRID]), cloud(2, missing=blocks), None, 1)
    assert len(found.regions) == len(blocks)
    for x, y, side, deep in blocks:
        (region,) = (each for each in found.regions if np.hypot(each.x_m - x, each.y_m - y) < 0.15)
        assert region.kind == "missing"
        assert abs(region.volume_m3 - side**2 * deep) < 3 * region.volume_std_m3
        assert region.depth_largest_m == pytest.approx(deep, rel=0.06)
        assert region.depth_median_m == pytest.approx(deep, rel=0.1 if side > 0.5 else 0.35)
        assert region.area_m2 == pytest.approx(side**2, rel=0.3)
        assert not region.marks


def test_added_rock_has_the_other_sign() -> None:
    found = compare_epoch(ReferenceHeights.of(cloud(1), [GRID]), cloud(2, missing=((8.0, 5.0, 1.0, -0.1),)), None, 1)
    (region,) = found.regions
    assert region.kind == "added"
    assert region.volume_m3 == pytest.approx(0.1, abs=3 * region.volume_std_m3)


def test_a_change_of_a_few_pixels_is_no_event() -> None:
    """Stray points 0.3 m before the wall within one pixel; a niche of 0.2 m is an event."""
    points = wall(2, missing=((4.0, 4.0, 0.2, 0.1),))
    stray = (np.abs(points[:, :2] - np.array([11.0, 6.0])) < 0.04).all(axis=1)
    points[stray, 2] += 0.3
    found = compare_epoch(ReferenceHeights.of(cloud(1), [GRID]), WallPoints.of(points), None, 1).regions
    assert [round(each.x_m) for each in found] == [4]


def test_noise_beside_a_niche_is_no_part_of_its_outline() -> None:
    """A niche of 6 x 6 pixels, 0.2 m deep, and a trail of noise, 1.2 levels of detection, that leads away from its corner."""
    raster = gridded(wall(1), GRID)
    difference = np.zeros(GRID.shape, dtype=np.float32)
    difference[50:56, 60:66] = 0.2
    for step in range(12):
        difference[55 + step, 65 + step : 68 + step] = np.maximum(difference[55 + step, 65 + step : 68 + step], 0.006)
    level = np.full(GRID.shape, 0.005, dtype=np.float32)
    noise = Significance(level, np.array([1.0, 63.0]), np.array([1.0, 1.0 / 63.0]))
    (region,) = find_regions(Change(difference, noise, np.full_like(difference, 1e-4), raster, raster))
    assert region.area_m2 == pytest.approx(36 * GRID.gsd**2)
    assert (region.width_m, region.height_m) == pytest.approx((6 * GRID.gsd, 6 * GRID.gsd))
    assert region.x_m == pytest.approx(GRID.x_min + 63 * GRID.gsd)


def test_nothing_is_found_where_nothing_fell() -> None:
    """Five pairs of 160 m2; the aim is one false event in 1,000 m2."""
    reference = ReferenceHeights.of(cloud(1), [GRID])
    assert sum(len(compare_epoch(reference, cloud(seed), None, 1).regions) for seed in range(2, 7)) <= 1


def test_epochs_that_do_not_overlap_are_refused() -> None:
    reference = ReferenceHeights.of(cloud(1), [GRID])
    with pytest.raises(InputError):
        compare_epoch(reference, WallPoints.of(wall(2) + np.array([200.0, 0.0, 0.0])), None, 1)


def test_an_event_keeps_its_number_and_a_new_one_gets_the_next() -> None:
    reference = ReferenceHeights.of(cloud(1), [GRID])
    first = compare_epoch(reference, cloud(2, missing=((3.0, 3.0, 0.6, 0.2),)), None, 1)
    second = compare_epoch(reference, cloud(3, missing=((3.0, 3.0, 0.7, 0.2), (10.0, 6.0, 1.2, 0.3))), None, 1)
    catalogue = Catalogue()
    assert [region.identity for region in catalogue.identified(first.regions)] == [1]
    numbers = {round(region.x_m): region.identity for region in catalogue.identified(second.regions)}
    assert numbers == {3: 1, 10: 2}


@pytest.mark.parametrize("exponent", [0.5, 1.0])
def test_the_exponent_of_a_power_law_comes_back(exponent: float) -> None:
    """1,000 volumes: a standard error of 3 %; the 95 % interval is within 10 % of the exponent."""
    volumes = 0.01 * (1 - np.random.default_rng(7).random(1000)) ** (-1 / exponent)
    law = fit_power_law(volumes)
    assert law is not None
    assert law.low < exponent < law.high
    assert law.exponent == pytest.approx(exponent, rel=0.12)


def test_few_volumes_have_no_law() -> None:
    assert fit_power_law([1.0, 2.0, 3.0]) is None
