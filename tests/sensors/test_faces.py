"""Both faces of the scanner, and a real pose that differs from the surveyed one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from surfaces import plane, step
from test_beam import beam
from test_tls import POSITION, ROTATION, scanner

from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.laser.faces import mean_of_faces
from sensors.laser.tls import LaserScanner
from sensors.models.placement import PoseSigma
from sensors.signal_chain.observation import Observation

TILTED = plane(np.array([0.5, 0.6, 1.0]), np.zeros(3), half_side=200.0)
ANGLE = 1e-3
WINDOW: dict[str, Any] = {"lines": 60, "pulses": 50}


def two_faced(sensor: LaserScanner, **settings: Any) -> LaserScanner:
    return replace(sensor, config=sensor.config.model_copy(update={"faces": 2, **settings}))


def second_face(sensor: LaserScanner) -> LaserScanner:
    return replace(sensor, pattern=sensor.pattern.second_face())


def seen_by(sensor: LaserScanner, mesh: TriangleMesh = TILTED, seed: int = 1) -> Observation:
    return sensor.observe(RayCaster(mesh), KeyedRandom(seed))


def test_the_second_face_records_the_same_points() -> None:
    sensor = scanner(**WINDOW)
    np.testing.assert_allclose(seen_by(second_face(sensor)).points, seen_by(sensor).points, atol=1e-9)


@pytest.mark.parametrize(
    "effect",
    [
        {"name": "collimation", "angle_rad": ANGLE},
        {"name": "trunnion_tilt", "angle_rad": ANGLE},
        {"name": "vertical_index", "offset_rad": ANGLE},
    ],
)
def test_axis_errors_change_sign_in_the_second_face_and_cancel_in_the_mean(effect: dict[str, Any]) -> None:
    """On a tilted plane: opposite to first order; the mean keeps a second order below R (c / sin z)^2 (1 + 2 tan^2 i)."""
    true, sensor = seen_by(scanner(**WINDOW)), scanner(effects=[effect], **WINDOW)
    first, second = (seen_by(each).depth - true.depth for each in (sensor, second_face(sensor)))
    mean = seen_by(two_faced(sensor)).depth - true.depth
    tan_squared = true.truth["cos_incidence"].astype(float) ** -2 - 1
    second_order = true.depth * (ANGLE / 0.95) ** 2 * (1 + 2 * tan_squared)
    assert np.abs(first).max() > 50 * second_order.max() * (0.1 if effect["name"] == "trunnion_tilt" else 1)
    assert (np.abs(first + second) < 2 * second_order).all()
    assert (np.abs(mean) < second_order).all()


def test_errors_that_both_faces_share_stay() -> None:
    sensor = two_faced(scanner(effects=[{"name": "range_offset", "offset_m": 0.02}], **WINDOW))
    np.testing.assert_allclose(seen_by(sensor).depth - seen_by(scanner(**WINDOW)).depth, 0.02, atol=1e-9)


def test_the_mean_of_two_faces_has_a_noise_smaller_by_the_root_of_two() -> None:
    """3,000 pulses: within 5 standard errors (6e-7)."""
    sensor = two_faced(scanner({"range_sigma_m": 0.01, "angle_sigma_rad": 0.0}, **WINDOW))
    residual = seen_by(sensor).depth - seen_by(scanner(**WINDOW)).depth
    assert residual.std() == pytest.approx(0.01 / np.sqrt(2), rel=5 / np.sqrt(2 * residual.size))


def test_faces_that_look_past_an_edge_on_either_side_are_not_averaged() -> None:
    """A vertical index does not change the azimuth, but collimation does: at a vertical edge the faces may see near and far
    surface.
    """
    sensor = scanner(effects=[{"name": "collimation", "angle_rad": 4 * ANGLE}], lines=100, pulses=20, step_rad=0.002)
    seen = seen_by(two_faced(sensor), step(1.5, 0.0))
    faces = [seen_by(each, step(1.5, 0.0)).depth for each in (sensor, second_face(sensor))]
    apart = np.abs(faces[0] - faces[1]) > 1
    assert apart.sum() > 20
    np.testing.assert_array_equal(seen.depth[apart], faces[0][apart])


def test_where_one_face_has_no_return_the_other_counts() -> None:
    first = seen_by(scanner(**WINDOW))
    hole, gap = first.depth.copy(), first.depth.copy()
    hole[3, 4], gap[5, 6] = np.nan, np.nan
    merged = mean_of_faces(replace(first, depth=hole), replace(first, depth=gap), 0.1)
    np.testing.assert_array_equal(merged.depth, first.depth)
    np.testing.assert_array_equal(merged.points, first.points)


def test_two_faces_and_several_returns_exclude_each_other() -> None:
    with pytest.raises(InputError, match=r"scanner\.faces"):
        seen_by(two_faced(scanner(effects=beam(mode="multiple"), **WINDOW)))


def displaced(sensor: LaserScanner, **sigma: float) -> LaserScanner:
    return replace(sensor, pose_sigma=PoseSigma(**sigma))


def test_points_are_recorded_from_the_surveyed_pose_while_the_scanner_stands_elsewhere() -> None:
    """Moved back by the difference of the poses, the points lie on the plane."""
    sigma, normal = PoseSigma(position_m=0.05, rotation_rad=0.002), np.array([0.5, 0.6, 1.0]) / np.linalg.norm([0.5, 0.6, 1.0])
    seen = seen_by(replace(scanner(**WINDOW), pose_sigma=sigma))
    position, rotation = sigma.displaced(POSITION, ROTATION, KeyedRandom(1).child("pose"))
    local = (seen.points - POSITION) @ ROTATION
    assert np.abs((local @ rotation.T + position) @ normal).max() < 1e-9
    assert np.abs(seen.points @ normal).max() > 0.01
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-15)


def test_poses_scatter_as_the_config_says_and_anew_for_every_look() -> None:
    """2,000 draws: the standard deviation of each coordinate and rotation is within 5 standard errors (12 x 6e-7)."""
    sigma, count = PoseSigma(position_m=0.03, rotation_rad=1e-3), 2000
    poses = [sigma.displaced(np.zeros(3), np.eye(3), KeyedRandom(1).child(number)) for number in range(count)]
    positions, turns = np.array([p for p, _ in poses]), np.array([[r[2, 1], r[0, 2], r[1, 0]] for _, r in poses])
    for values, expected in ((positions, 0.03), (turns, 1e-3)):
        np.testing.assert_allclose(values.std(axis=0), expected, rtol=5 / np.sqrt(2 * count))
        assert np.abs(values.mean(axis=0)).max() < 5 * expected / np.sqrt(count)


def test_a_pose_known_exactly_changes_nothing() -> None:
    sensor = scanner({"range_sigma_m": 0.01, "angle_sigma_rad": 1e-4}, **WINDOW)
    assert seen_by(displaced(sensor)).points.tobytes() == seen_by(sensor).points.tobytes()
    moved = seen_by(displaced(sensor, position_m=0.1)).points
    assert moved.tobytes() == seen_by(displaced(sensor, position_m=0.1)).points.tobytes()
