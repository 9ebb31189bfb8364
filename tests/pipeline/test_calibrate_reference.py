"""Calibration on references made of points: the reference's error must not be attributed to the instrument."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.workshop import rays
from pipeline.calibration.calibrate import calibrate
from pipeline.calibration.inputs import CalibrationInputs, _angular_spacing, read_inputs
from pipeline.calibration.reference_error import ReferenceError
from pipeline.calibration.report import warnings
from pipeline.calibration.window_simulator import WindowSimulator
from pipeline.calibration.write import to_dict
from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import SimulationConfig, load_config
from pipeline.formats.measurements.measurement import TlsMeasurement, read_measurement
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.measurement.build import Request, build
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.models.sensor_model import TlsModel

pytestmark = pytest.mark.usefixtures("undrawn")

EYE = np.array([0.0, -30.0, 0.0])
NOISE_M = 0.003
SETTINGS = [
    "icp=null",
    "difference.gsd_m=0.05",
    "calibration.windows=8",
    "calibration.window_px=24",
    "calibration.simulations=60",
]


def wall(rng: np.random.Generator, count: int = 40) -> TriangleMesh:
    """A wavy wall of 8 x 8 m, seen from -y."""
    x, z = np.meshgrid(*[np.linspace(-4, 4, count)] * 2, indexing="ij")
    vertices = np.stack([x, 0.3 * np.sin(x) * np.cos(z) + 0.02 * rng.standard_normal(x.shape), z], axis=-1).reshape(-1, 3)
    number = np.arange(count**2).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    return TriangleMesh(vertices, faces.astype(np.int32))


@pytest.mark.parametrize("shared", [True, False])
def test_points_lie_as_far_from_the_wall_as_from_one_whose_vertices_are_wrong(shared: bool) -> None:
    """For noise, distances are compared with ray casting on that wall, to 1 % of the noise.

    For relief, which neighbours do not share, the variance is the sum of the squared weights, within 3 standard errors.
    """
    mesh, rng = wall(np.random.default_rng(1)), np.random.default_rng(2)
    caster, sigma = RayCaster(mesh), 1e-3
    ray = rays(*rng.uniform([[np.pi / 2 - 0.11], [np.pi / 2 - 0.11]], [[np.pi / 2 + 0.11], [np.pi / 2 + 0.11]], (2, 5000)))
    distance, face = caster.cast(EYE, ray)
    points = EYE + distance[:, None] * ray
    moved = ReferenceError(sigma, shared, EYE).moved(points, caster, KeyedRandom(3))
    nearer = distance - np.linalg.norm(moved - EYE, axis=1)
    np.testing.assert_allclose(np.cross(moved - EYE, ray), 0, atol=1e-9)
    if shared:
        sight = mesh.vertices - EYE
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        errors = sigma * KeyedRandom(3).generator().standard_normal(len(sight))
        wrong = RayCaster(mesh.with_vertices(mesh.vertices + errors[:, None] * sight))
        off = nearer - (wrong.cast(EYE, ray)[0] - distance)
        assert np.sqrt(np.mean(off**2)) < 0.01 * sigma
    else:
        corners = mesh.vertices[mesh.faces[face]]
        weight = np.linalg.solve(np.swapaxes(corners, 1, 2), points[:, :, None])[:, :, 0]
        z = nearer / (sigma * np.linalg.norm(weight, axis=1))
        assert abs(z.std() - 1) < 3 / np.sqrt(2 * len(z))


def test_points_that_are_missing_or_miss_the_wall_stay() -> None:
    points = np.array([[np.nan] * 3, [50.0, 0.0, 0.0]])
    moved = ReferenceError(1e-3, True, EYE).moved(points, RayCaster(wall(np.random.default_rng(1))), KeyedRandom(3))
    np.testing.assert_array_equal(moved, points)


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return half_of_scan(tmp_path_factory.mktemp("half"), 360)


def half_of_scan(folder: Path, lines: int) -> Path:
    """One half of a scan of a wall against the other, with 3 mm of noise where the model claims 1 mm."""
    rng = np.random.default_rng(4)
    line, pulse = (each.ravel() for each in np.indices((lines, lines)))
    ray = rays(np.pi / 2 - 0.12 + line * 6.6e-4, np.pi / 2 - 0.12 + pulse * 6.6e-4)
    mesh = wall(rng, 9)
    distance, face = RayCaster(mesh).cast(EYE, ray)
    points = ((distance + NOISE_M * rng.standard_normal(len(ray)))[:, None] * ray)[face >= 0]
    (folder / "model.yaml").write_text(
        yaml.safe_dump({"sensor": "tls", "noise": {"range_sigma_m": 1e-3, "angle_sigma_rad": 1e-6}})
    )
    write_laz(folder / "scan.laz", PointCloud(points))
    build(Request([folder / "scan.laz"], "half", model=folder / "model.yaml", position=(0.0, 0.0, 0.0)), folder / "half")
    return folder / "half"


def inputs(half: Path) -> tuple[SimulationConfig, CalibrationInputs]:
    config = load_config(bundled_config("", "demo"), [*SETTINGS, "calibration.fit=[range_sigma_m]"], "tls", None)
    return config, read_inputs([half], config, "tls", KeyedRandom(1))


def test_maps_of_a_half_are_as_noisy_as_measured_only_with_the_reference_error(half: Path) -> None:
    """Without it the simulated maps have less than 0.85 of the measured deviation; with it they agree to 8 %.

    The remainder comes from the points' layout: those of a half lie like one colour of a chessboard, simulated ones on squares,
    with about three per pixel.
    """
    config, found = inputs(half)
    assert found.reference_error is not None
    assert found.reference_error.sigma_m == pytest.approx(NOISE_M, rel=0.1)
    windows = found.windows(config)
    measured = np.nanstd(np.stack([windows.cut(values) for values in found.maps]))
    model = TlsModel.model_validate({"noise": {"range_sigma_m": NOISE_M, "angle_sigma_rad": 1e-6}})

    def deviation(error: ReferenceError | None) -> float:
        simulator = WindowSimulator(config, found.site, windows, of_points=True, reference_error=error)
        return float(np.nanstd(simulator.maps(model, 2, KeyedRandom(5))))

    assert deviation(found.reference_error) == pytest.approx(measured, rel=0.08)
    assert deviation(None) < 0.85 * measured


def test_points_that_lie_in_one_direction_are_an_input_error(tmp_path: Path) -> None:
    measurement = read_measurement(half_of_scan(tmp_path, 150))
    assert isinstance(measurement, TlsMeasurement)
    step = _angular_spacing(measurement)
    assert step == pytest.approx(6.6e-4 * np.sqrt(2), rel=0.03)
    twice = PointCloud(np.repeat(measurement.cloud.points[:100], 70, axis=0), extra={"epoch": np.full(7000, 3)})
    with pytest.raises(InputError, match="in one direction"):
        _angular_spacing(measurement.changed(cloud=twice))


@pytest.mark.slow
def test_the_noise_of_the_instrument_comes_back_from_a_half(half: Path) -> None:
    """Within twice the 95 % interval, at most 8 %; without the reference's error it would be a quarter larger."""
    config, _ = inputs(half)
    result = calibrate(config, "tls", [half], Progress(), with_greedy=False)
    (value,), (low,), (high,) = (np.exp(each) for each in (result.found.x, result.found.low, result.found.high))
    assert abs(np.log(value / NOISE_M)) < min(np.log(high / low), 0.08)
    assert any("3.01 mm" in text for text in warnings(result))
    assert to_dict(result)["reference_error_m"] == pytest.approx(0.00301)
