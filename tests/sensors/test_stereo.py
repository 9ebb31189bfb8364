"""The stereo sensor against closed forms: plane, sphere, step edge, the geometry's precision, the analytic covariance."""

from __future__ import annotations

import numpy as np
import pytest
from surfaces import heightfield, plane, sphere, step

from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import CameraPair
from sensors.cameras.rectification import rectify
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel
from sensors.signal_chain.observation import Observation
from sensors.stereo.stereo_pair import StereoPair

QUIET = {"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}
# The wall frame's x is the world's x, its y the world's z, its z the world's -y: a vertical wall, cameras in the south.
FRAME = WallFrame(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.zeros(3))
ORIGIN = np.zeros(3)


def rig(distance: float = 105.0, base: float = 28.0, **changes: float) -> CameraPair:
    wall = TriangleMesh(FRAME.to_world(plane(np.array([0, 0, 1.0]), ORIGIN).vertices), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    return RigConfig(distance_m=distance, base_m=base, width=1840, height=1228, **changes).place(Target(wall))


def observe(mesh: TriangleMesh, noise: dict, seed: int = 1, quality: str = "high", pair: CameraPair | None = None) -> Observation:
    model = StereoModel(noise={**QUIET, **noise})
    sensor = StereoPair(pair or rig(k1=-0.05, k2=0.03), FRAME, model, quality, truth=True)
    return sensor.observe(RayCaster(mesh), KeyedRandom(seed))


def test_without_noise_a_tilted_plane_comes_back_to_a_micrometre() -> None:
    normal = np.array([0.3, -0.2, 1.0])
    seen = observe(plane(normal, ORIGIN), {})
    assert seen.valid.mean() > 0.5
    distance = seen.points[seen.valid] @ normal / np.linalg.norm(normal)
    assert np.abs(distance).max() < 1e-6  # the issue asks for 0.1 mm


def test_without_noise_a_sphere_comes_back_within_its_tessellation() -> None:
    """Vertices lie on the sphere, so the surface is at most the sagitta e^2 / 8 r inside of it (e: longest edge)."""
    radius, subdivisions = 12.0, 6
    seen = observe(sphere(ORIGIN, radius, subdivisions), {})
    inside = radius - np.linalg.norm(seen.points[seen.valid], axis=1)
    longest_edge = 1.3 * radius / 2**subdivisions
    assert inside.min() > -1e-6
    assert inside.max() < longest_edge**2 / 2 / radius


def test_a_step_hides_a_strip_from_the_right_camera_of_the_closed_form_width() -> None:
    """The near plane (x > 0, z = 2) hides a strip of the far one (z = 0) left of the edge, as the right camera's ray says.

    A ray from the right camera at (b/2, Z) over the edge (0, 2) meets z = 0 at x = -(b/2) 2 / (Z - 2); from the left camera the
    strip is in full view.
    """
    distance, base, height = 105.0, 28.0, 2.0
    seen = observe(step(height, 0.0), {})
    far = seen.points[seen.valid & (np.abs(seen.points[..., 2]) < 0.5)]
    strip = base / 2 * height / (distance - height)
    cell = 2 * distance / rig().left.f_px
    assert far[:, 0].max() == pytest.approx(-strip, abs=1.5 * cell)


def test_precision_is_that_of_the_normal_case_at_glendale() -> None:
    """sigma_Z = Z^2 / (c B) sigma_p: 2.7 cm for 0.5 px in each image, that is 0.5 sqrt(2) px of parallax.

    40,000 cells: the standard deviation is known to 0.35 %, so 2 % holds with a false-failure rate below 1e-6.
    """
    pair = RigConfig().place(
        Target(
            TriangleMesh(
                FRAME.to_world(plane(np.array([0, 0, 1.0]), ORIGIN).vertices), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
            )
        )
    )
    sensor = StereoPair(pair, FRAME, StereoModel(noise={**QUIET, "parallax_sigma_px": 0.5 * np.sqrt(2)}), "low", truth=True)
    seen = sensor.observe(RayCaster(plane(np.array([0, 0, 1.0]), ORIGIN, half_side=3.0)), KeyedRandom(3))
    error = seen.points[seen.valid][:, 2]
    expected = 105.0**2 / (pair.left.f_px * 28.0) * 0.5 * np.sqrt(2)
    assert expected == pytest.approx(0.027, abs=5e-4)
    assert error.size > 5_000
    assert error.std() == pytest.approx(expected, rel=5 / np.sqrt(2 * error.size))


def test_matching_noise_propagates_as_the_analytic_covariance() -> None:
    """The error of a point is along its left ray with sigma = |dP/dd| sigma_d, P = C + z(d) ray, z = f B / (d - d_inf).

    Standardised errors are N(0, 1): mean within 5 / sqrt(n), variance within 5 sqrt(2 / n) (false failures below 1e-6 each);
    nothing is left across the ray.
    """
    sigma = 0.3
    mesh = plane(np.array([0.2, 0.1, 1.0]), ORIGIN)
    pair = rig()
    truth, seen = observe(mesh, {}, pair=pair), observe(mesh, {"parallax_sigma_px": sigma}, pair=pair)
    error = (seen.points - truth.points)[seen.valid & truth.valid]
    ray = (truth.points - seen.viewpoint)[seen.valid & truth.valid]
    length = np.linalg.norm(ray, axis=1)
    left, right = (FRAME.to_wall(one.position) for one in (pair.left, pair.right))
    base_direction = (right - left) / np.linalg.norm(right - left)
    across = ray - (ray @ base_direction)[:, None] * base_direction  # from the base to the point: z of the rectified frame, and y
    up = np.cross(base_direction, np.array([0, 0, 1.0]))
    z = np.sqrt(np.sum(across**2, axis=1) - (across @ up / np.linalg.norm(up)) ** 2)
    expected = length * z / (pair.left.f_px * pair.base_m) * sigma  # dP/dd = ray dz/dd / z, dz/dd = -z^2 / (f B)
    along = np.einsum("ij,ij->i", error, ray) / length
    score = along / expected
    assert np.abs(np.linalg.norm(error, axis=1) - np.abs(along)).max() < 1e-6
    assert abs(score.mean()) < 5 / np.sqrt(score.size) + 0.01  # 0.01: z is not quite linear in d
    assert score.var() == pytest.approx(1.0, abs=5 * np.sqrt(2 / score.size) + 0.01)


def test_regularization_noise_has_the_variance_of_bilinear_interpolation() -> None:
    """Averaged over the image, 4/9 of the nodes' variance; the far nodes are independent, neighbours in a cell are not."""
    mesh, pair, step_px = plane(np.array([0, 0, 1.0]), ORIGIN), rig(), 32.0
    noise = {"regularization_sigma_px": 0.5, "regularization_step_px": step_px}
    variances, correlations = [], []
    for seed in range(8):
        truth, seen = observe(mesh, {}, pair=pair), observe(mesh, noise, seed=seed, pair=pair)
        infinity_free = pair.left.f_px * pair.base_m
        disparity_error = infinity_free / seen.depth - infinity_free / truth.depth  # near enough for a small convergence
        rows = disparity_error[200:400, 200:700]
        variances.append(np.nanvar(rows))
        correlations.append(np.corrcoef(rows[:, :-1].ravel(), rows[:, 1:].ravel())[0, 1])
    assert np.mean(variances) == pytest.approx(4 / 9 * 0.25, rel=0.1)  # 8 x about 400 nodes: 2.5 % expected
    assert np.mean(correlations) > 0.97


def test_zero_noise_on_a_rough_wall_is_better_than_the_reference() -> None:
    """Sampled as the depth map is: mean 0.05 mm and StD 0.5 mm (the thesis has 0.12 and 1.09 mm against Metashape)."""
    wall = heightfield(30.0, 20.0, 0.1)
    mesh = wall.with_vertices(wall.vertices - [15.0, 10.0, 0.0])
    seen = observe(mesh, {})
    points = seen.points[seen.valid]
    top, _ = RayCaster(mesh).cast(points + np.array([0, 0, 5.0]), np.broadcast_to([0.0, 0, -1.0], points.shape))
    error = top - 5.0
    error = error[np.isfinite(error) & (np.abs(error) < 1.0)]  # points under an overhang of the view are seen past the top
    assert abs(error.mean()) < 5e-5
    assert error.std() < 5e-4


def test_orientation_noise_is_drawn_anew_for_each_observation_and_scaled_by_its_sigma() -> None:
    orientation = StereoModel(noise={"orientation": {"cx_px": 4.5, "phi_rad": {"mean": 1e-4, "sigma": 0.0}}}).noise.orientation
    draws = [{effect.name: effect for effect in orientation.draw("left", KeyedRandom(seed))} for seed in range(400)]
    shifts = np.array([draw["principal_point_x"].delta_px for draw in draws])
    assert shifts.std() == pytest.approx(4.5, rel=5 / np.sqrt(2 * 400))
    assert {draw["camera_phi"].angle_rad for draw in draws} == {1e-4}
    assert all(draw["focal_length"].is_null for draw in draws)


def test_camera_effects_act_as_brute_force_projection_says() -> None:
    """Project what a real pixel sees into the real right camera, intersect the nominal rays: the point that is recorded.

    The oracle triangulates in NumPy: along the left nominal ray to the depth of the rectified disparity.
    """
    mesh, pair = plane(np.array([0.1, 0.2, 1.0]), ORIGIN), rig(k1=-0.05)
    effects = [
        {"name": "focal_length", "camera": "left", "delta_px": 2.0},
        {"name": "principal_point_x", "camera": "right", "delta_px": -1.5},
        {"name": "camera_phi", "camera": "right", "angle_rad": 1e-4},
        {"name": "camera_shift", "camera": "left", "y_m": 0.02},
    ]
    sensor = StereoPair(pair, FRAME, StereoModel(noise=QUIET, effects=effects), "low")
    seen = sensor.observe(RayCaster(mesh), KeyedRandom(1))
    nominal = pair.in_wall_frame(FRAME)
    real = pair.changed("left", f_px=2.0).changed("right", cx_px=-1.5).rotated("right", 1, 1e-4)
    real = real.shifted("left", np.array([0.0, 0.02, 0.0])).in_wall_frame(FRAME)
    normal = np.array([0.1, 0.2, 1.0])
    for row, column in ((40, 60), (76, 115), (110, 180)):
        u, v = (column + 0.5) * 8, (row + 0.5) * 8
        ray = real.left.rotation @ [*real.left.tangents(u, v), 1.0]
        point = real.left.position - ray * (normal @ real.left.position) / (normal @ ray)
        local = real.right.rotation.T @ (point - real.right.position)
        right_u, right_v = real.right.pixel(local[0] / local[2], local[1] / local[2])
        geometry = rectify(nominal)
        left_ray = geometry.left @ [*nominal.left.tangents(u, v), 1.0]
        right_ray = geometry.right @ [*nominal.right.tangents(right_u, right_v), 1.0]
        depth = geometry.base_m / (left_ray[0] / left_ray[2] - right_ray[0] / right_ray[2])
        recorded = nominal.left.position + nominal.left.rotation @ geometry.left.T @ (left_ray / left_ray[2] * depth)
        np.testing.assert_allclose(seen.points[row, column], recorded, atol=1e-5)
        assert np.linalg.norm(recorded - point) > 0.01


def test_the_same_key_gives_the_same_bytes_and_another_seed_another_noise() -> None:
    mesh = plane(np.array([0, 0, 1.0]), ORIGIN)
    noise = {"parallax_sigma_px": 0.3, "regularization_sigma_px": 0.2}
    first, again, other = (observe(mesh, noise, seed, "low") for seed in (5, 5, 6))
    assert first.points.tobytes() == again.points.tobytes()
    assert first.points.tobytes() != other.points.tobytes()


def test_a_pair_that_does_not_see_the_wall_is_refused() -> None:
    with pytest.raises(InputError, match="seen by both cameras"):
        observe(plane(np.array([0, 0, 1.0]), np.array([0.0, 0.0, 300.0])), {})  # behind the cameras


def test_a_plane_is_seen_from_its_back_as_from_its_front() -> None:
    front, back = (observe(plane(np.array([0, 0, side]), ORIGIN), {}) for side in (1.0, -1.0))
    np.testing.assert_array_equal(back.valid, front.valid)
    np.testing.assert_allclose(back.points[back.valid], front.points[front.valid], atol=1e-9)
