"""The laser scanner against closed forms: plane, sphere, step edge, range equation, distributions of the noise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy import stats
from scipy.spatial import cKDTree
from surfaces import heightfield, plane, sphere, step

from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import DEFAULT_ALBEDO, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.effects import TLS_EFFECTS
from sensors.laser import tls
from sensors.laser.tls import LaserScanner, Pattern, ScannerConfig
from sensors.models.placement import check_in_front
from sensors.models.sensor_model import TlsModel
from sensors.signal_chain.observation import Observation
from sensors.signal_chain.pulses import Pulses

QUIET = {"range_sigma_m": 0.0, "angle_sigma_rad": 0.0}
SIGNIFICANCE = 1e-5
"""False-failure rate of each statistical test here; seeds are fixed, so a test that passes once passes always."""
# On z = 50 m, looking down -z: the scanner's x axis is -z, its y axis x, its z axis y (turned so that the frame is right-handed).
POSITION = np.array([0.3, -0.2, 50.0])
ROTATION = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])


def scanner(
    noise: dict[str, float] | None = None, lines: int = 200, pulses: int = 150, step_rad: float = 0.004, **model: Any
) -> LaserScanner:
    pattern = Pattern(-step_rad * lines / 2, step_rad, lines, np.pi / 2 - step_rad * pulses / 2, step_rad, pulses)
    return LaserScanner(POSITION, ROTATION, pattern, ScannerConfig(), TlsModel(noise=noise or QUIET, **model), truth=True)


def scan(mesh: TriangleMesh, noise: dict[str, float] | None = None, seed: int = 1, **options: Any) -> Observation:
    return scanner(noise, **options).observe(RayCaster(mesh), KeyedRandom(seed))


def test_without_noise_a_tilted_plane_comes_back_to_a_nanometre() -> None:
    normal = np.array([0.3, 0.5, 1.0])
    seen = scan(plane(normal, np.zeros(3)))
    assert np.abs(seen.points[seen.valid] @ normal / np.linalg.norm(normal)).max() < 1e-9


def test_without_noise_points_lie_on_a_rough_wall_to_a_micrometre() -> None:
    """Compared with double-precision distances to the mesh; at a triangle's edge float32 tracing may take the neighbour."""
    wall = heightfield(30.0, 20.0, 0.25)
    mesh = wall.with_vertices(wall.vertices - [15.0, 10.0, 0.0])
    seen = scan(mesh, lines=300, pulses=200, step_rad=0.002)
    assert distance_to_mesh(seen.points[seen.valid], mesh).max() < 1e-6


def distance_to_mesh(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """Return distances (n,), m, in double precision, to the nearest of the 16 triangles whose centres are nearest."""
    corners = mesh.vertices[mesh.faces]
    _, near = cKDTree(corners.mean(axis=1)).query(points, k=16)
    on_triangle = trimesh.triangles.closest_point(corners[near.ravel()], np.repeat(points, 16, axis=0))
    return np.linalg.norm(on_triangle.reshape(-1, 16, 3) - points[:, None], axis=2).min(axis=1)


def test_a_sphere_has_the_closed_form_ranges_within_its_tessellation() -> None:
    radius, subdivisions = 6.0, 7
    seen = scan(sphere(np.zeros(3), radius, subdivisions))
    inside = radius - np.linalg.norm(seen.points[seen.valid], axis=1)
    assert inside.min() > -1e-9
    assert inside.max() < (1.3 * radius / 2**subdivisions) ** 2 / 2 / radius


def test_a_step_edge_is_recorded_without_points_between_its_two_planes() -> None:
    seen = scan(step(1.5, 0.0))
    z = seen.points[seen.valid][:, 2]
    assert np.minimum(np.abs(z - 1.5), np.abs(z)).max() < 1e-9
    at_edge = seen.points[seen.valid & (np.abs(seen.points[..., 2] - 1.5) < 0.1)]
    assert at_edge[:, 0].min() > -1e-5


def test_directions_are_the_contracts_angles() -> None:
    """In the scanner's frame azimuth = atan2(y, x), and zenith is from +z.

    Rows are lines in azimuth, columns run in zenith.
    """
    sensor = scanner()
    seen = sensor.observe(RayCaster(plane(np.array([0, 0, 1.0]), np.zeros(3))), KeyedRandom(1))
    local = (seen.points - POSITION) @ ROTATION
    azimuth, zenith = np.arctan2(local[..., 1], local[..., 0]), np.arctan2(np.hypot(local[..., 0], local[..., 1]), local[..., 2])
    pattern = sensor.pattern
    expected_azimuth = pattern.azimuth_start + pattern.azimuth_step * np.arange(pattern.lines)[:, None]
    expected_zenith = pattern.zenith_start + pattern.zenith_step * np.arange(pattern.pulses)[None, :]
    np.testing.assert_allclose(azimuth, np.broadcast_to(expected_azimuth, azimuth.shape), atol=1e-12)
    np.testing.assert_allclose(zenith, np.broadcast_to(expected_zenith, zenith.shape), atol=1e-12)
    np.testing.assert_allclose(seen.depth, np.linalg.norm(local, axis=-1), atol=1e-10)


def test_intensity_follows_the_range_equation() -> None:
    normal = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
    seen = scan(plane(normal, np.zeros(3)))
    assert seen.intensity is not None
    ray = (seen.points - POSITION) / seen.depth[..., None]
    expected = DEFAULT_ALBEDO * -(ray @ normal) * (100.0 / seen.depth) ** 2
    np.testing.assert_allclose(seen.intensity, expected, rtol=2e-6)


def test_time_runs_from_pulse_to_pulse_at_the_pulse_rate() -> None:
    seen = scan(plane(np.array([0, 0, 1.0]), np.zeros(3)))
    assert seen.gps_time is not None
    np.testing.assert_allclose(np.diff(seen.gps_time.ravel()), 1e-5, rtol=1e-9)


def test_range_noise_is_normal_with_both_figures_of_the_datasheet_in_quadrature() -> None:
    noise = {"range_sigma_m": 0.002, "range_ppm": 50.0, "angle_sigma_rad": 0.0}
    seen = scan(plane(np.array([0, 0, 1.0]), np.zeros(3)), noise)
    true_range = seen.truth["true_range_m"][seen.valid]
    score = (seen.depth[seen.valid] - true_range) / np.hypot(0.002, 50e-6 * true_range)
    assert stats.kstest(score, "norm").pvalue > SIGNIFICANCE
    white = np.corrcoef(score[:-1], score[1:])[0, 1]
    assert abs(white) < stats.norm.isf(SIGNIFICANCE / 2) / np.sqrt(score.size)


def test_angle_noise_moves_the_range_as_the_analytic_covariance_says() -> None:
    """On a plane with unit normal n, p = R u: dR = -R (n . du) / (n . u), du the emitted minus the nominal direction.

    The recorded point keeps the nominal direction, so the whole error is in range: standardised it is N(0, 1).
    """
    sigma, normal = 5e-5, np.array([0.4, 0.3, 1.0])
    seen = scan(plane(normal, np.zeros(3)), {"range_sigma_m": 0.0, "angle_sigma_rad": sigma})
    nominal = (seen.points - POSITION) @ ROTATION / seen.depth[..., None]
    zenith, azimuth = np.arccos(nominal[..., 2]), np.arctan2(nominal[..., 1], nominal[..., 0])
    by_azimuth = np.stack([-np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.zeros_like(zenith)], axis=-1)
    by_zenith = np.stack([np.cos(zenith) * np.cos(azimuth), np.cos(zenith) * np.sin(azimuth), -np.sin(zenith)], axis=-1)
    local_normal = normal @ ROTATION
    slope = seen.depth / (nominal @ local_normal)
    expected = sigma * np.hypot(slope * (by_azimuth @ local_normal), slope * (by_zenith @ local_normal))
    plane_range = -(POSITION @ normal) / (nominal @ local_normal)
    score = ((seen.depth - plane_range) / expected)[seen.valid]
    assert stats.kstest(score, "norm").pvalue > SIGNIFICANCE


@pytest.mark.parametrize(
    ("entry", "error"),
    [
        ({"name": "range_offset", "offset_m": 0.004}, lambda true_range: np.full_like(true_range, 0.004)),
        ({"name": "tls.range_scale", "scale_ppm": 20.0}, lambda true_range: 20e-6 * true_range),
    ],
)
def test_systematic_range_effects_add_their_equation(entry: dict[str, Any], error: Any) -> None:
    seen = scan(plane(np.array([0.2, 0, 1.0]), np.zeros(3)), effects=[entry])
    true_range = seen.truth["true_range_m"][seen.valid]
    np.testing.assert_allclose(seen.depth[seen.valid] - true_range, error(true_range), atol=1e-12)


@pytest.mark.parametrize("effect", TLS_EFFECTS, ids=lambda kind: kind.__name__)
def test_an_effect_at_its_null_is_the_identity(effect: type) -> None:
    pulses = Pulses(*[None] * 8)
    assert effect().is_null
    assert effect().apply(pulses, None) is pulses


def test_random_numbers_are_keyed_by_pulse_and_seed() -> None:
    noise = {"range_sigma_m": 0.003, "angle_sigma_rad": 5e-5}
    wall = plane(np.array([0, 0, 1.0]), np.zeros(3))
    first, again, other = (scan(wall, noise, seed) for seed in (5, 5, 6))
    assert first.points.tobytes() == again.points.tobytes()
    assert first.points.tobytes() != other.points.tobytes()


def test_two_effects_of_one_name_draw_independent_numbers() -> None:
    effects = [{"name": "range_noise", "sigma_m": 0.003}] * 2
    seen = scan(plane(np.array([0, 0, 1.0]), np.zeros(3)), effects=effects)
    error = seen.depth[seen.valid] - seen.truth["true_range_m"][seen.valid]
    assert error.std() == pytest.approx(0.003 * np.sqrt(2), rel=5 / np.sqrt(2 * error.size))


def test_the_window_is_derived_from_the_wall_and_covers_it() -> None:
    wall = heightfield(30.0, 20.0, 0.5)
    mesh = wall.with_vertices(wall.vertices - [15.0, 10.0, 0.0])
    config = ScannerConfig(azimuth_step_rad=0.004, zenith_step_rad=0.004)
    aimed = LaserScanner.aimed((POSITION, ROTATION), WallFrame.identity(), mesh.vertices, config, TlsModel(noise=QUIET))
    seen = aimed.observe(RayCaster(mesh), KeyedRandom(1))
    low, high = (np.nanquantile(seen.points[..., :2], share, axis=(0, 1)) for share in (0.0, 1.0))
    spacing = 0.004 * 52.0
    np.testing.assert_allclose(low, [-15.0, -10.0], atol=1.5 * spacing)
    np.testing.assert_allclose(high, [15.0, 10.0], atol=1.5 * spacing)
    assert not seen.valid[0].any() or not seen.valid[-1].any() or seen.valid.mean() > 0.8


def test_ranges_outside_the_instruments_reach_are_not_recorded() -> None:
    mesh = plane(np.array([0, 0, 1.0]), np.zeros(3))
    pattern = scanner().pattern
    near = LaserScanner(POSITION, ROTATION, pattern, ScannerConfig(maximum_range_m=51.0), TlsModel(noise=QUIET), truth=True)
    seen = near.observe(RayCaster(mesh), KeyedRandom(1))
    assert 0 < seen.valid.mean() < 1
    assert np.nanmax(seen.depth) <= 51.0


def test_a_scanner_behind_the_rock_is_refused() -> None:
    check_in_front(RayCaster(heightfield(30.0, 20.0, 0.5)), POSITION, "station")
    with pytest.raises(InputError, match="in or behind it"):
        check_in_front(RayCaster(heightfield(30.0, 20.0, 0.5)), POSITION * [1, 1, -1], "station")
    ball = sphere(np.zeros(3), 5.0, 3)
    with pytest.raises(InputError, match="in or behind it"):
        check_in_front(RayCaster(ball), np.array([1.0, 0.0, 0.0]), "station")
    with pytest.raises(InputError, match="no pulse of the scanner returned"):
        scan(plane(np.array([0, 0, 1.0]), np.array([0.0, 0.0, 90.0])))


def test_a_plane_is_scanned_from_its_back_as_from_its_front() -> None:
    front, back = (scan(plane(np.array([0, 0, side]), np.zeros(3))) for side in (1.0, -1.0))
    np.testing.assert_array_equal(back.valid, front.valid)
    np.testing.assert_allclose(back.depth[back.valid], front.depth[front.valid], atol=1e-9)
    np.testing.assert_array_equal(back.intensity[back.valid], front.intensity[front.valid])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"zenith_step_rad": -0.001}, "greater than 0"),
        ({"zenith_limits_rad": [30.0, 130.0]}, "degrees"),
        ({"azimuth_rad": [1.0, 0.5]}, "start must be smaller"),
        ({"pulse_rate_hz": "fast"}, "valid number"),
        ({"azimuth_step": 0.001}, "did you mean 'azimuth_step_rad'"),
    ],
)
def test_wrong_scanner_settings_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse(ScannerConfig, values, "config")


def test_a_pattern_may_fill_the_free_memory_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ScannerConfig(azimuth_step_rad=0.01, zenith_step_rad=0.01)
    windows = (0.0, 0.09), (1.0, 1.19)  # 10 lines of 20 pulses
    for missing, fits in ((0, True), (1, False)):
        free = SimpleNamespace(available=200 * tls._BYTES_PER_PULSE - missing)
        monkeypatch.setattr(tls.psutil, "virtual_memory", lambda free=free: free)
        if fits:
            assert Pattern.over(*windows, settings).pulses == 20
        else:
            with pytest.raises(InputError, match="10 lines with 20 pulses"):
                Pattern.over(*windows, settings)
