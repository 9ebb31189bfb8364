"""The stereo pair measured vertex by vertex: exact without noise, the analytic covariance, and agreement with the
ray-traced way.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from surfaces import heightfield, plane

from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel
from sensors.stereo.stereo_pair import StereoPair
from sensors.stereo.stereo_vertices import observe_vertices

QUIET = {"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}
FRAME = WallFrame(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.zeros(3))
FACING = plane(np.array([0, 0, 1.0]), np.zeros(3))
TABLE_4_3_M = np.array([4.0e-6, 1.7e-6, 6.2e-6])
"""Standard deviations of x, y and z of the reconstructed minus the reference vertices."""


def pair(noise: dict[str, Any] | None = None, effects: tuple[dict[str, Any], ...] = (), **lens: float) -> StereoPair:
    cameras = RigConfig(distance_m=105.0, base_m=28.0, width=1840, height=1228, **(lens or {"k1": -0.05, "k2": 0.03}))
    rig = cameras.place(Target(FACING.with_vertices(FRAME.to_world(FACING.vertices))))
    return StereoPair(rig, FRAME, StereoModel(noise={**QUIET, **(noise or {})}, effects=effects), "high", truth=True)


def rough(width: float = 30.0, height: float = 20.0, spacing: float = 0.1, roughness: float = 0.1) -> TriangleMesh:
    wall = heightfield(width, height, spacing, roughness)
    return wall.with_vertices(wall.vertices - [width / 2, height / 2, 0.0])


def test_without_noise_every_vertex_comes_back_within_the_references_own_figures() -> None:
    mesh = rough()
    seen = observe_vertices(pair(), RayCaster(mesh), KeyedRandom(1))
    error = seen.vertices - mesh.vertices
    assert (error.std(axis=0) <= TABLE_4_3_M).all()
    assert np.abs(error).max() < 1e-9  # the thesis's figures are the rounding of a file
    np.testing.assert_array_equal(seen.faces, mesh.faces)


def test_matching_noise_propagates_as_the_analytic_covariance() -> None:
    """Along the left ray with sigma = |dP/dd| sigma_d, dP/dd = -P z / (f B) (P from the left camera, z its rectified depth).

    Standardised errors are N(0, 1): mean within 5 / sqrt(n), variance within 5 sqrt(2 / n) (false failures below 1e-6 each).
    """
    mesh, sigma = rough(roughness=0.0), 0.3
    sensor = pair({"parallax_sigma_px": sigma}, k1=0.0)
    seen = observe_vertices(sensor, RayCaster(mesh), KeyedRandom(2))
    cameras = sensor.cameras.in_wall_frame(FRAME)
    base = cameras.right.position - cameras.left.position
    ray, error = mesh.vertices - cameras.left.position, seen.vertices - mesh.vertices
    outwards = np.cross(base, [0.0, 1.0, 0.0])  # the rectified axis is square to the base and to the wall frame's y
    z = np.abs(ray @ outwards) / np.linalg.norm(outwards)
    length = np.linalg.norm(ray, axis=1)
    along = np.einsum("ij,ij->i", error, ray) / length
    score = along / (length * z / (sensor.cameras.left.f_px * sensor.cameras.base_m) * sigma)
    assert np.abs(np.linalg.norm(error, axis=1) - np.abs(along)).max() < 1e-9
    assert abs(score.mean()) < 5 / np.sqrt(score.size) + 0.01  # 0.01: z is not quite linear in d
    assert score.var() == pytest.approx(1.0, abs=5 * np.sqrt(2 / score.size) + 0.01)


def heights_under(surface: TriangleMesh, places: FloatArray) -> FloatArray:
    start = np.column_stack([places, np.full(len(places), 50.0)])
    distance, _ = RayCaster(surface).cast(start, np.broadcast_to([0.0, 0.0, -1.0], start.shape))
    return 50.0 - distance


@pytest.mark.parametrize(
    "effects",
    [
        (
            {"name": "principal_point_x", "camera": "left", "delta_px": 0.4},
            {"name": "camera_kappa", "camera": "left", "angle_rad": 5e-4},
        ),
        ({"name": "row_jitter", "camera": "left", "amplitude_px": 0.3, "rows_per_cycle": 400.0},),
        ({"name": "row_jitter", "camera": "both", "amplitude_px": 2.0, "rows_per_cycle": 900.0},),
        ({"name": "pixel_locking", "amplitude_px": 0.3},),
        ({"name": "smoothing", "sigma_px": 12.0},),
        ({"name": "disparity_empirical", "along": {"low": 0.0, "high": 1840.0}, "values_px": ((0.0, 0.5),)},),
    ],
    ids=["cameras", "left rows", "both rows", "locking", "smoothing", "empirical"],
)
def test_on_a_smooth_and_finely_sampled_wall_both_ways_give_one_surface(effects: tuple[dict[str, Any], ...]) -> None:
    """A ray-traced sample lies on the surface through the vertices: what is left is the curvature within a triangle."""
    mesh = rough(spacing=0.05, width=24.0, height=14.0, roughness=0.01)
    sensor, scene = pair(effects=effects), RayCaster(mesh)
    surface = observe_vertices(sensor, scene, KeyedRandom(4))
    seen = sensor.observe(scene, KeyedRandom(4))
    points = seen.points[seen.valid]
    points = points[(np.abs(points[:, :2]) < [10.0, 5.0]).all(axis=1)]
    error = points[:, 2] - heights_under(surface, points[:, :2])
    size = np.std(points[:, 2] - heights_under(mesh, points[:, :2]))
    assert size > 3e-3 or effects[0]["name"] == "smoothing"  # the effect is there
    assert np.abs(np.median(error)) < 1e-4
    assert np.quantile(np.abs(error), 0.99) < max(5e-4, 0.05 * size)


def test_regularization_noise_is_the_depth_maps_own_and_parallax_noise_is_each_vertexs() -> None:
    mesh = rough(roughness=0.0)
    scene = RayCaster(mesh)
    smooth = pair({"regularization_sigma_px": 0.5})
    points = smooth.observe(scene, KeyedRandom(5)).points.reshape(-1, 3)
    points = points[(np.abs(points[:, :2]) < [12.0, 8.0]).all(axis=1)]
    surface = observe_vertices(smooth, scene, KeyedRandom(5))
    error = points[:, 2] - heights_under(surface, points[:, :2])
    assert np.std(error) < 0.1 * np.std(points[:, 2])
    white = observe_vertices(pair({"parallax_sigma_px": 0.3}), scene, KeyedRandom(5)).vertices[:, 2].reshape(201, 301)
    assert abs(np.corrcoef(white[:, 1:].ravel(), white[:, :-1].ravel())[0, 1]) < 5 / np.sqrt(white.size)


def test_fattening_changes_the_far_side_of_a_step_as_it_does_in_the_depth_map() -> None:
    """A ledge 3 m high: the far plane beside it gets the near depth, as far as the outline grows.

    From the left camera, 14 m aside, the ledge's edge (0.1, 3) is seen over x = 14.1 105 / 102 - 14 of the far plane.
    """
    x, y = np.meshgrid(np.arange(-6, 6.001, 0.1), np.arange(-4, 4.001, 0.1))
    z = np.where(x > 0, 3.0, 0.0)
    number = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    a, b, c, d = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, 1:].ravel(), number[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    mesh = TriangleMesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces)
    radius, pixel_m = 24.0, 105.0 / pair().cameras.left.f_px
    fat = observe_vertices(pair(effects=({"name": "edge_fattening", "radius_px": radius},)), RayCaster(mesh), KeyedRandom(1))
    raised = (fat.vertices[:, 2] > 1.5) & (mesh.vertices[:, 2] < 1.5)
    assert np.abs(fat.vertices[mesh.vertices[:, 2] > 1.5] - mesh.vertices[mesh.vertices[:, 2] > 1.5]).max() < 1e-9
    reach = -mesh.vertices[raised, 0].min()
    assert reach == pytest.approx(radius * pixel_m - (14.1 * 105 / 102 - 14), abs=2 * pixel_m + 0.1)


def test_texture_noise_is_larger_where_there_is_none() -> None:
    mesh = rough(roughness=0.0)
    random = np.random.default_rng(0)
    albedo = np.where(mesh.vertices[:, 0] > 0, random.uniform(0.1, 0.9, len(mesh.vertices)), 0.5).astype(np.float32)
    sensor = pair(effects=({"name": "texture_noise", "coefficient": 2.0},))
    error = observe_vertices(sensor, RayCaster(replace(mesh, vertex_albedo=albedo)), KeyedRandom(1)).vertices - mesh.vertices
    bare, textured = (np.std(error[side, 2]) for side in (mesh.vertices[:, 0] < -1, mesh.vertices[:, 0] > 1))
    assert bare > 3 * textured > 0


def test_what_is_not_in_both_images_is_left_out_and_labels_stay_with_their_triangles() -> None:
    mesh = rough(width=160.0, height=6.0, spacing=0.5)
    label = np.arange(len(mesh.faces), dtype=np.int32)
    seen = observe_vertices(pair(), RayCaster(replace(mesh, face_block=label)), KeyedRandom(1))
    assert 0 < len(seen.faces) < len(mesh.faces)
    assert seen.face_block is not None
    np.testing.assert_allclose(seen.corners(), mesh.corners(seen.face_block), atol=1e-9)
    assert len(seen.vertices) == len(np.unique(seen.faces))


def test_the_same_key_gives_the_same_bytes_and_another_one_does_not() -> None:
    mesh, sensor = rough(), pair({"parallax_sigma_px": 0.3, "regularization_sigma_px": 0.2, "orientation": {"cx_px": 0.5}})
    first, again, other = (observe_vertices(sensor, RayCaster(mesh), KeyedRandom(seed)).vertices for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_a_wall_behind_the_cameras_is_an_input_error() -> None:
    mesh = rough()
    with pytest.raises(InputError, match="seen by both cameras"):
        observe_vertices(pair(), RayCaster(mesh.with_vertices(mesh.vertices + np.array([0.0, 0.0, 300.0]))), KeyedRandom(1))
