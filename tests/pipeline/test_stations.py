"""Several stations of a laser scanner: registration against known pose errors, merging, files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from surfaces import heightfield
from test_run import config

from pipeline.change.difference import DifferenceConfig, raster_grid, surface_raster
from pipeline.formats.points.laz import read_laz
from pipeline.registration.register import IcpConfig
from pipeline.registration.rigid import RigidTransform
from pipeline.run.simulation import simulate
from pipeline.surface.mesh import SurfaceConfig, mesh_observation
from pipeline.surface.stations import JoinedStations, StationsConfig, join_stations, merge_stations
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.placement import EXACT_POSE, PoseSigma
from sensors.models.sensor_model import TlsModel

pytestmark = pytest.mark.usefixtures("undrawn")

WALL = heightfield(16.0, 10.0, 0.1, roughness=0.15)
CASTER = RayCaster(WALL)
SIGMA_M = 0.002
RASTER = DifferenceConfig(gsd_m=0.04)
SECOND_POSE = PoseSigma(position_m=0.02, rotation_rad=5e-4)
TO_THE_END = IcpConfig(delta_threshold=1e-6, threshold=1e-10)
LEFT, RIGHT = (-1.0, 5.0, 18.0), (17.0, 5.0, 18.0)


def station(position: tuple[float, float, float], pose_sigma: PoseSigma = EXACT_POSE, step_rad: float = 0.002) -> LaserScanner:
    """Return a scanner that faces the wall's middle, with its vertical axis along y."""
    forward = (np.array([8.0, 5.0, 0.0]) - position) * [1, 0, 1]
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 1.0, 0.0])
    pose = np.array(position), np.stack([forward, np.cross(up, forward), up], axis=1)
    settings = ScannerConfig(azimuth_step_rad=step_rad, zenith_step_rad=step_rad)
    model = TlsModel(noise={"range_sigma_m": SIGMA_M, "angle_sigma_rad": 0.0})
    return LaserScanner.aimed(pose, WallFrame.identity(), WALL.vertices, settings, model, pose_sigma=pose_sigma)


def joined(scanners: list[LaserScanner], seed: int, icp: IcpConfig | None = TO_THE_END) -> JoinedStations:
    random = KeyedRandom(seed)
    seen = [scanner.observe(CASTER, random.child(number)) for number, scanner in enumerate(scanners)]
    return join_stations(scanners, seen, StationsConfig(icp=icp), SurfaceConfig(), RASTER, random.child("stations"))


def pose_error(scanner: LaserScanner, random: KeyedRandom) -> RigidTransform:
    """Return the transform from recorded to true coordinates."""
    position, rotation = scanner.pose_sigma.displaced(scanner.position, scanner.rotation, random.child("pose"))
    turn = rotation @ scanner.rotation.T
    return RigidTransform(turn, position - turn @ scanner.position)


def misfit(found: RigidTransform, true: RigidTransform) -> FloatArray:
    """Return how far the transforms are apart on the wall (n,), m."""
    return np.linalg.norm(found.apply(WALL.vertices) - true.apply(WALL.vertices), axis=1)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_stations_with_wrong_poses_are_registered_to_the_noise_over_the_root_of_the_points(seed: int) -> None:
    """Two stations with wrong poses are registered to 40 sigma / sqrt(n), 0.3 mm here, anywhere on the wall.

    The relief (slopes of about 0.3) determines shifts along the wall three times less well than across. Both stations are noisy,
    neighbouring pairs share reference points, and the wall's worst corner counts.
    """
    scanners = [station(LEFT), station(RIGHT, SECOND_POSE)]
    result = joined(scanners, seed)
    true = pose_error(scanners[1], KeyedRandom(seed).child(1))
    (found,) = result.registrations
    assert found.converged
    tolerance = 40 * SIGMA_M / np.sqrt(found.inliers)
    assert misfit(found.transform, true).max() < tolerance
    assert misfit(RigidTransform.identity(), true).min() > 5 * tolerance


def test_the_re_setup_error_is_what_the_registration_reports() -> None:
    """Over ten epochs the registrations scatter like the poses: not at all where these are exact, by the pose error otherwise."""
    exact = joined([station(LEFT), station(RIGHT)], 1).registrations[0]
    assert misfit(exact.transform, RigidTransform.identity()).max() < 40 * SIGMA_M / np.sqrt(exact.inliers)
    moved = [
        joined([station(LEFT, step_rad=0.005), station(RIGHT, SECOND_POSE, 0.005)], seed).registrations[0] for seed in range(10)
    ]
    shifts = [found.apply(np.array(RIGHT)) - RIGHT for found in moved]
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(0.02, rel=5 / np.sqrt(60))  # 30 numbers, 5 standard errors


def test_without_registration_the_surveyed_poses_stand() -> None:
    result = joined([station(LEFT), station(RIGHT, SECOND_POSE)], 1, icp=None)
    assert result.registrations == ()
    assert len(result.observations) == 2


def test_the_merged_surface_covers_what_either_station_sees_and_is_the_better_ones_there() -> None:
    """The merged surface has a height at each pixel that either station sees, equal to one of theirs.

    Each station sees two thirds of the wall. Beside a station the height is that station's.
    """
    scanners = [station(LEFT), station(RIGHT)]
    random = KeyedRandom(4)
    meshes = []
    for number, scanner in enumerate(scanners):
        seen = scanner.observe(CASTER, random.child(number))
        points = seen.points.copy()
        points[(points[..., 0] > 11) if number == 0 else (points[..., 0] < 5)] = np.nan
        meshes.append(
            mesh_observation(
                replace(seen, points=points, depth=np.where(np.isnan(points[..., 0]), np.nan, seen.depth)), SurfaceConfig()
            )
        )
    surface = merge_stations(scanners, meshes, RASTER)
    bounds = np.stack([np.min([m.bounds[0] for m in meshes], axis=0), np.max([m.bounds[1] for m in meshes], axis=0)])
    grid = raster_grid(bounds, RASTER)
    heights = surface_raster(surface, grid).heights
    left, right = (surface_raster(mesh, grid).heights for mesh in meshes)
    np.testing.assert_array_equal(np.isnan(heights), np.isnan(left) & np.isnan(right))
    same = np.isclose(heights, left, atol=1e-5) | np.isclose(heights, right, atol=1e-5) | np.isnan(heights)
    assert same.all()
    third = grid.width // 5
    for near, columns in ((left, np.s_[:, : 2 * third]), (right, np.s_[:, -2 * third :])):
        both = ~np.isnan(near[columns])
        assert np.mean(np.isclose(heights[columns], near[columns], atol=1e-5)[both]) > 0.99
    assert len(surface.faces) < 0.85 * sum(len(mesh.faces) for mesh in meshes)
    assert surface.vertex_block is not None


def test_a_dense_station_wins_over_a_coarse_one_in_the_same_place() -> None:
    coarse, dense = station(LEFT, step_rad=0.004), station(LEFT)
    meshes = [mesh_observation(scanner.observe(CASTER, KeyedRandom(1)), SurfaceConfig()) for scanner in (coarse, dense)]
    surface = merge_stations([coarse, dense], meshes, RASTER)
    assert len(meshes[1].faces) <= len(surface.faces) < 1.05 * len(meshes[1].faces)


TWO: list[dict[str, Any]] = [
    {"distance_m": 20.0},
    {"distance_m": 15.0, "height_m": 3.0, "pose_sigma": {"position_m": 0.01, "rotation_rad": 2e-4}},
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("stations") / "run"
    beam = {"name": "beam_divergence", "divergence_rad": 0.003, "mode": "multiple", "sub_rays": 7, "pulse_width_s": 3e-10}
    scanner = {"azimuth_step_rad": 0.003, "zenith_step_rad": 0.003}
    simulate(config(station=TWO, scanner=scanner, sensor=[{"sensor": "tls", "effects": [beam]}]), "tls", out)
    return out


def test_a_run_with_two_stations_holds_the_points_of_both(finished: Path) -> None:
    cloud = read_laz(finished / "epoch_001/points.laz")
    assert set(np.unique(cloud.extra["station"])) == {1, 2}
    assert cloud.extra["true_range_m"].shape == cloud.extra["station"].shape
    epochs = json.loads((finished / "run.json").read_text())["epochs"]
    for record in epochs:
        (registered,) = record["stations"]
        assert registered["converged"]
        assert 1e-4 < np.linalg.norm(registered["translation_m"]) < 0.1
    assert epochs[1]["points"] == len(cloud.points)
    assert epochs[0]["stations"] != epochs[1]["stations"]
    assert abs(epochs[1]["statistics"]["outside_blocks"]["median_m"]) < 0.005


def test_returns_are_numbered_in_the_file(finished: Path) -> None:
    """The returns of a pulse follow each other, numbered from 1 to their count."""
    cloud = read_laz(finished / "epoch_001/points.laz")
    number, count = (cloud.extra[name] for name in ("return_number", "number_of_returns"))
    assert count.max() >= 2
    assert cloud.gps_time is not None
    starts = np.flatnonzero(number == 1)
    sizes = np.diff(starts, append=len(number))
    np.testing.assert_array_equal(count[starts], sizes)
    np.testing.assert_array_equal(cloud.gps_time, np.repeat(cloud.gps_time[starts], sizes))
    assert (np.diff(cloud.gps_time)[np.diff(cloud.extra["station"].astype(int)) == 0] >= 0).all()


@pytest.mark.parametrize(
    ("station_values", "message"),
    [
        ([], "station"),
        ([{"distance_m": 20.0}, {"distanz_m": 20.0}], "distance_m"),
        ([{"distance_m": 20.0}, {"position_m": [4.0, 30.0, 2.0]}], "station, number 2"),
    ],
)
def test_wrong_stations_are_named(tmp_path: Path, station_values: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate(config(station=station_values), "tls", tmp_path / "run")
