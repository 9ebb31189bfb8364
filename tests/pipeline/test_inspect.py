"""`scarpsim inspect`: geometry and precision against closed forms on planes, against the sensors' own noise; the command."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import stats
from surfaces import plane, step

from pipeline.api.configs import configure
from pipeline.cli import main as cli
from pipeline.config.simulation import SimulationConfig, load_config
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.planning.inspect import write_plans
from pipeline.planning.maps import plans
from pipeline.planning.report import answer
from pipeline.precision.stereo_geometry import stereo_geometry
from pipeline.precision.surface import Places, visible_from, wall_raster
from pipeline.precision.tls_geometry import TlsGeometry, tls_geometry
from pipeline.report import figures
from pipeline.report.figures import map_figure
from pipeline.run.site import prepare_site
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import Camera, CameraPair
from sensors.laser.tls import LaserScanner, Pattern, ScannerConfig
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.stereo.stereo_pair import StereoPair

pytestmark = pytest.mark.usefixtures("undrawn")

SIGNIFICANCE = 1e-5
"""False-failure rate of each statistical test here; seeds are fixed."""
FRAME = WallFrame(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.zeros(3))
TILTED = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
POSITION = np.array([0.3, -0.2, 50.0])
ROTATION = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
STEP_RAD = 0.004


def scanner(noise: dict[str, float] | None = None, effects: tuple[dict[str, Any], ...] = (), steps: int = 200) -> LaserScanner:
    pattern = Pattern(-STEP_RAD * steps / 2, STEP_RAD, steps, np.pi / 2 - STEP_RAD * steps / 2, STEP_RAD, steps)
    model = TlsModel(noise=noise or {"range_sigma_m": 0.0, "angle_sigma_rad": 0.0}, effects=effects)
    return LaserScanner(POSITION, ROTATION, pattern, ScannerConfig(), model, truth=True)


def parallel_pair(z: float = 100.0, base: float = 20.0, **noise: Any) -> StereoPair:
    """Return the normal case of photogrammetry: both axes along -z of the wall frame."""
    downwards = FRAME.rotation.T @ np.diag([1.0, -1.0, -1.0])
    interior = {"f_px": 2000.0, **dict.fromkeys(("cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2"), 0.0)}
    left, right = (
        Camera(1600, 1200, **interior, position=FRAME.to_world(np.array([x, 0.0, z])), rotation=downwards)
        for x in (-base / 2, base / 2)
    )
    return StereoPair(CameraPair(left, right), FRAME, StereoModel(noise={"regularization_sigma_px": 0.0, **noise}), "high")


def convergent_pair(width: int = 1840, height: int = 1228, **noise: Any) -> StereoPair:
    world = TriangleMesh(
        FRAME.to_world(plane(np.array([0, 0, 1.0]), np.zeros(3)).vertices), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    )
    rig = RigConfig(width=width, height=height, k1=-0.05, k2=0.03).place(Target(world))
    return StereoPair(rig, FRAME, StereoModel(noise={"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0, **noise}), "low")


def spread_over(normal: np.ndarray, half_side: float = 12.0, count: int = 25) -> Places:
    """Return a grid of places on the plane through the origin."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-half_side, half_side, count)] * 2))
    points = np.stack([x, y, -(normal[0] * x + normal[1] * y) / normal[2]], axis=1)
    return Places(points, np.tile(normal, (len(points), 1)), np.full(len(points), 0.5))


def test_the_normal_case_has_the_textbook_formulas_all_over_a_parallel_wall() -> None:
    """sigma_Z = Z^2/(cB) sigma_d, sigma_X = x/Z sigma_Z, GSD = Z/c, base to distance, convergence."""
    places = spread_over(np.array([0.0, 0.0, 1.0]))
    found = stereo_geometry(parallel_pair(parallax_sigma_px=0.5), places)
    sigma = np.sqrt(np.einsum("nii->ni", found.covariance))
    sigma_z = 100.0**2 / (2000.0 * 20.0) * 0.5
    np.testing.assert_allclose(sigma[:, 2], sigma_z, rtol=1e-9)
    np.testing.assert_allclose(sigma[:, 0], np.abs(places.points[:, 0] + 10.0) / 100.0 * sigma_z, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.gsd_m, 100.0 / 2000.0, rtol=1e-9)
    np.testing.assert_allclose(found.base_to_distance, 20.0 / np.hypot(100.0, np.hypot(*places.points[:, :2].T)), rtol=1e-9)
    below = np.argmin(np.abs(places.points[:, :2]).sum(axis=1))
    assert found.convergence_rad[below] == pytest.approx(2 * np.arctan(10.0 / 100.0))


def test_measured_image_points_have_the_covariance_of_the_least_squares_intersection() -> None:
    """The expected value is (J' J)^-1, with J the numerical derivatives of all four image coordinates, in the normal case."""
    places = spread_over(TILTED, count=5)
    found = stereo_geometry(parallel_pair(parallax_sigma_px=0.0), places, image_sigma_px=0.4)

    def image(point: np.ndarray) -> np.ndarray:
        return np.concatenate([[(point[0] - x) / (100 - point[2]), point[1] / (100 - point[2])] for x in (-10.0, 10.0)]) * 2000.0

    for point, covariance in zip(places.points, found.covariance, strict=True):
        jacobian = np.stack([(image(point + delta) - image(point - delta)) / 2e-4 for delta in 1e-4 * np.eye(3)], axis=1)
        np.testing.assert_allclose(covariance, 0.4**2 * np.linalg.inv(jacobian.T @ jacobian), rtol=1e-5, atol=1e-12)


def test_glendale_has_the_references_precision() -> None:
    """2.7 cm in z for 0.5 px in each image, that is 0.5 sqrt(2) px of parallax; 3 % are allowed because the cameras converge."""
    middle = Places(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.array([0.5]))
    found = stereo_geometry(convergent_pair(7360, 4912, parallax_sigma_px=0.5 * np.sqrt(2)), middle)
    assert np.sqrt(found.covariance[0, 2, 2]) == pytest.approx(0.027, rel=0.03)


def test_the_stereo_covariance_is_that_of_the_sensors_own_noise() -> None:
    """Errors of the recorded points along x, y and z, standardised by the covariance, are N(0, 1); a lens with distortion."""
    mesh = plane(TILTED, np.zeros(3))
    noisy, quiet = (convergent_pair(parallax_sigma_px=sigma) for sigma in (0.4, 0.0))
    recorded, truth = (sensor.observe(RayCaster(mesh), KeyedRandom(3)) for sensor in (noisy, quiet))
    seen = recorded.valid & truth.valid
    points = truth.points[seen]
    found = stereo_geometry(noisy, Places(points, np.tile(TILTED, (len(points), 1)), np.full(len(points), 0.5)))
    score = (recorded.points[seen] - points) / np.sqrt(np.einsum("nii->ni", found.covariance))
    assert all(stats.kstest(score[:, axis], "norm").pvalue > SIGNIFICANCE for axis in range(3))
    normal_score = (recorded.points[seen] - points) @ TILTED / found.normal_sigma_m
    assert stats.kstest(normal_score, "norm").pvalue > SIGNIFICANCE


def test_the_orientations_covariance_is_that_of_many_observations() -> None:
    """Distances of recorded points from a plane, over 150 draws: known to 6 %; 25 % holds with a false-failure rate of 1e-4."""
    mesh, orientation = plane(TILTED, np.zeros(3)), {"phi_rad": 5e-5, "cx_px": 0.3, "k1": 0.003, "f_px": 0.5, "x_m": 0.01}
    sensor = convergent_pair(460, 306, orientation=orientation)
    caster = RayCaster(mesh)
    draws = np.array([sensor.observe(caster, KeyedRandom(seed)).points @ TILTED for seed in range(150)])
    points = convergent_pair(460, 306).observe(caster, KeyedRandom(0)).points
    cells = ~np.isnan(draws).any(axis=0) & ~np.isnan(points[..., 0])
    found = stereo_geometry(sensor, Places(points[cells], np.tile(TILTED, (cells.sum(), 1)), np.full(cells.sum(), 0.5)))
    expected = np.sqrt(np.einsum("i,nij,j->n", TILTED, found.orientation_covariance, TILTED))
    measured = np.sqrt(np.square(draws[:, cells]).mean(axis=0))
    assert np.median(measured / expected) == pytest.approx(1.0, rel=0.15)
    assert np.abs(measured / expected - 1).max() < 0.25


def on_plane(found: TlsGeometry, places: Places) -> tuple[np.ndarray, np.ndarray]:
    sight = places.points - POSITION
    range_m = np.linalg.norm(sight, axis=1)
    np.testing.assert_allclose(found.range_m, range_m, rtol=1e-12)
    return range_m, -(sight / range_m[:, None]) @ TILTED


def test_range_incidence_footprint_and_power_of_the_scanner_are_closed_forms() -> None:
    places = spread_over(TILTED)
    found = tls_geometry(scanner(effects=({"name": "beam_divergence", "divergence_rad": 3e-4},)), places)
    range_m, cosine = on_plane(found, places)
    np.testing.assert_allclose(np.cos(found.incidence_rad), cosine, rtol=1e-9)
    np.testing.assert_allclose(found.footprint_m, 3e-4 * range_m, rtol=1e-12)
    np.testing.assert_allclose(found.footprint_long_m, 3e-4 * range_m / cosine, rtol=1e-9)
    np.testing.assert_allclose(found.power, 0.5 * cosine * (100 / range_m) ** 2, rtol=1e-9)


def test_the_point_spacing_is_that_of_the_scan() -> None:
    """Distances of neighbouring points of a noiseless scan of a plane; second order in the step, 4 mrad."""
    seen = scanner().observe(RayCaster(plane(TILTED, np.zeros(3))), KeyedRandom(1)).points
    middle = seen[1:-1, 1:-1]
    cells = ~np.isnan(middle[..., 0]) & (np.abs(middle[..., :2]).max(axis=-1) < 15)
    points = middle[cells]
    found = tls_geometry(scanner(), Places(points, np.tile(TILTED, (len(points), 1)), np.full(len(points), 0.5)))
    line = np.linalg.norm(seen[2:, 1:-1] - seen[:-2, 1:-1], axis=-1)[cells] / 2
    pulse = np.linalg.norm(seen[1:-1, 2:] - seen[1:-1, :-2], axis=-1)[cells] / 2
    np.testing.assert_allclose(found.spacing_line_m, line, rtol=1e-4)
    np.testing.assert_allclose(found.spacing_pulse_m, pulse, rtol=1e-4)


def test_the_scanners_precision_along_the_normal_is_that_of_its_own_noise() -> None:
    noise = {"range_sigma_m": 0.002, "range_ppm": 50.0, "angle_sigma_rad": 6e-5}
    seen = scanner(noise).observe(RayCaster(plane(TILTED, np.zeros(3))), KeyedRandom(5))
    points = seen.points[seen.valid]
    found = tls_geometry(scanner(noise), Places(points, np.tile(TILTED, (len(points), 1)), np.full(len(points), 0.5)))
    assert stats.kstest(points @ TILTED / found.normal_sigma_m, "norm").pvalue > SIGNIFICANCE


def test_the_mean_of_two_faces_is_as_precise_as_its_own_noise() -> None:
    """Standardised by the prediction, the errors of some 15,000 points have the variance 1, within chi-square's bounds."""
    both = replace(scanner({"range_sigma_m": 0.002, "angle_sigma_rad": 6e-5}), config=ScannerConfig(faces=2))
    points = both.observe(RayCaster(plane(TILTED, np.zeros(3))), KeyedRandom(3)).points.reshape(-1, 3)
    points = points[~np.isnan(points[:, 0])]
    places = Places(points, np.tile(TILTED, (len(points), 1)), np.full(len(points), 0.5))
    squared = np.square(points @ TILTED / tls_geometry(both, places).normal_sigma_m).sum()
    low, high = stats.chi2.ppf([SIGNIFICANCE / 2, 1 - SIGNIFICANCE / 2], len(points))
    assert low < squared < high


def test_the_scanners_error_ellipsoid_is_that_of_noisy_polar_coordinates() -> None:
    """100,000 draws of range, azimuth and zenith turned into points: variances to 0.45 %; 2.5 % of the largest holds."""
    noise = {"range_sigma_m": 0.004, "range_ppm": 0.0, "angle_sigma_rad": 1e-4}
    place = Places(np.array([[9.0, 11.0, 1.0]]), TILTED[None], np.array([0.5]))
    found = tls_geometry(scanner(noise), place)
    x, y, z = (place.points[0] - POSITION) @ ROTATION
    range_m, azimuth, zenith = np.sqrt(x * x + y * y + z * z), np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)
    draw = np.random.default_rng(2).normal(size=(3, 100_000)) * np.array([[0.004], [1e-4], [1e-4]])
    r, a, t = range_m + draw[0], azimuth + draw[1], zenith + draw[2]
    points = np.stack([r * np.sin(t) * np.cos(a), r * np.sin(t) * np.sin(a), r * np.cos(t)], axis=1) @ ROTATION.T
    measured = np.cov(points.T)
    np.testing.assert_allclose(found.covariance[0], measured, atol=0.025 * measured.max())
    axes = [found.range_sigma_m[0], found.azimuth_sigma_m[0], found.zenith_sigma_m[0]]
    np.testing.assert_allclose(np.sort(np.square(axes)), np.linalg.eigvalsh(found.covariance[0]), rtol=1e-9)


def test_a_step_hides_a_strip_of_the_closed_form_width() -> None:
    """The near plane (x > 0, z = 2) hides from (x_v, Z) the far one's strip -x_v 2 / (Z - 2) < x < 0."""
    raster = wall_raster(RayCaster(step(2.0, 0.0)), gsd_m=0.05)
    viewpoint = np.array([12.0, 1.0, 50.0])
    seen = visible_from(RayCaster(step(2.0, 0.0)), raster.places, viewpoint)
    hidden = raster.image(~seen)
    widths = 0.05 * np.nansum(hidden, axis=1)
    np.testing.assert_allclose(widths, 12.0 * 2.0 / 48.0, atol=0.051)


def test_places_out_of_window_reach_and_power_are_not_reached() -> None:
    places = spread_over(np.array([0.0, 0.0, 1.0]), half_side=39.0, count=79)
    found = tls_geometry(scanner(), places)
    seen = scanner().observe(RayCaster(plane(np.array([0, 0, 1.0]), np.zeros(3))), KeyedRandom(1)).points[..., :2]
    low, high = np.nanmin(seen, axis=(0, 1)), np.nanmax(seen, axis=(0, 1))
    outside = ((places.points[:, :2] < low - 0.3) | (places.points[:, :2] > high + 0.3)).any(axis=1)
    assert outside.any()
    assert not found.reached[outside].any()
    assert found.reached[np.abs(places.points[:, :2]).max(axis=1) < 15].all()
    faint = tls_geometry(scanner(effects=({"name": "detection_limit", "minimum_power": 1.5},)), places)
    np.testing.assert_array_equal(faint.reached, found.reached & (found.power >= 1.5))


CONFIG = """
wall: {style: glendale, width_m: 8.0, height_m: 5.0, resolution_m: 0.1, seed: 7}
cameras: {distance_m: 50.0, base_m: 13.0, width: 1840, height: 1228}
station: {distance_m: 50.0}
scanner: {azimuth_step_rad: 0.001, zenith_step_rad: 0.001}
planning: {gsd_m: 0.1, block_size_m: [0.2]}
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "site.yaml"
    path.write_text(CONFIG)
    return path


def test_the_command_writes_maps_figures_and_a_report(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "plan"
    assert cli.main(["inspect", str(config), "--sensor", "stereo", "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [plan["sensor"] for plan in printed["plans"]] == ["stereo"]
    assert json.loads((out / "plan.json").read_text())["plans"] == printed["plans"]
    for plan in printed["plans"]:
        for name, summary in plan["maps"].items():
            raster, grid = read_geotiff(out / f"{plan['sensor']}_{name}.tif")
            assert grid.gsd == pytest.approx(0.1)
            if summary["median"] is not None:
                assert np.nanmedian(raster) == pytest.approx(summary["median"], rel=1e-5, abs=1e-9)
    report = (out / "report.html").read_text()
    assert report.count("data:image/png;base64,") == sum(len(plan["maps"]) + 1 for plan in printed["plans"])
    assert "http://" not in report


def test_the_command_says_which_block_is_seen(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["inspect", str(config), "--sensor", "tls", "--set", "station.distance_m=100"]
    assert cli.main([*words, "--out", str(tmp_path / "plan")]) == 0
    printed = capsys.readouterr().out
    assert "at a typical place in the middle of the wall, the fall of a block with sides of" in printed
    assert "Stereo" not in printed


def test_several_stations_are_planned_together_and_one_by_one(config: Path, tmp_path: Path) -> None:
    """Together they see what any of them sees, each place with the best station's values; times and pulses are summed."""
    second = "station=[{distance_m: 50.0}, {position_m: [-12.0, -15.0, 1.5]}]"
    loaded = load_config(config, [second, "scanner.faces=2"], "tls", None)
    together, *single = plans(loaded, prepare_site(loaded, "tls", KeyedRandom(loaded.seed)))
    assert [plan.station for plan in (together, *single)] == [None, 1, 2]
    maps = [{each.name: each.values for each in plan.maps} for plan in (together, *single)]
    np.testing.assert_array_equal(maps[0]["views"], maps[1]["views"] + maps[2]["views"])
    assert {1, 2} <= set(maps[0]["views"])
    np.testing.assert_array_equal(maps[0]["normal_sigma_m"], np.fmin(maps[1]["normal_sigma_m"], maps[2]["normal_sigma_m"]))
    chosen = np.where(maps[0]["normal_sigma_m"] == maps[2]["normal_sigma_m"], maps[2]["range_m"], maps[1]["range_m"])
    np.testing.assert_array_equal(maps[0]["range_m"], chosen)
    scanned = sum(scanner.pattern.lines * scanner.pattern.pulses for scanner in stations_of(loaded))
    assert together.figures["pulses"] == 2 * scanned
    assert together.figures["seen"] > max(plan.figures["seen"] for plan in single)
    report = write_plans(tmp_path / "plan", loaded, [together, *single])
    assert "2 stations together, mean of two faces" in report.read_text()
    assert (tmp_path / "plan" / "tls_station_2_range_m.tif").is_file()


def stations_of(config: SimulationConfig) -> list[LaserScanner]:
    site = prepare_site(config, "tls", KeyedRandom(config.seed))
    return [site.sensor, *site.further_stations]


def test_wet_rock_returns_less_power(config: Path) -> None:
    dry, wet = (load_config(config, ["wetness={share: 1.0, albedo_factor: 0.25}"] * number, "tls", None) for number in (0, 1))
    power = [
        next(each.values for each in plans(loaded, prepare_site(loaded, "tls", KeyedRandom(1)))[0].maps if each.name == "power")
        for loaded in (dry, wet)
    ]
    seen = np.isfinite(power[0])
    np.testing.assert_allclose(power[1][seen], 0.25 * power[0][seen], rtol=1e-5)


def test_without_a_sensor_the_configs_own_are_inspected(config: Path) -> None:
    assert load_config(config, [], None, None).sensor_names() == ("stereo", "tls")
    assert load_config(config, ["scanner=riegl_vz400i"], None, None).sensor_names() == ("tls",)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--set", "planning.gsd_m=20"], "planning.gsd_m: a pixel of 20 m is too large or too small for a wall"),
        (["--set", "planning.gsd_m=1e-5"], "planning.gsd_m: a pixel of 1e-05 m is too large or too small for a wall"),
        (["--set", "planning.probability=2"], "'planning.probability': input should be less than 1"),
        (["--set", "planing.gsd_m=1"], "did you mean 'planning'?"),
        (["--sensor", "lidar"], "allowed: stereo, tls"),
        (
            ["--set", "station.rotation=[[-1,0,0],[0,-1,0],[0,0,1]]", "--set", "scanner.azimuth_rad=[3.0,3.2]"],
            "seen by the scanner",
        ),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(
    words: list[str], message: str, config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["inspect", str(config), "--out", str(tmp_path / "plan"), *words, "--quiet"]) == 2
    output = capsys.readouterr().err
    assert message in output
    assert output.count("\n") == 1


def test_a_folder_in_use_is_left_alone(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["inspect", str(config), "--sensor", "tls", "--out", str(tmp_path)]) == 2
    assert "is not an empty folder" in capsys.readouterr().err


def test_a_missing_config_is_an_input_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["inspect", str(tmp_path / "none.yaml")]) == 2
    assert "cannot be read" in capsys.readouterr().err


SET_UPS: dict[str, tuple[str, dict[str, Any]]] = {
    "pair, near": ("stereo", {"wall__width_m": 8.0, "wall__height_m": 5.0, "cameras__distance_m": 12.0, "cameras__base_m": 3.0}),
    "pair, far": ("stereo", {"cameras__distance_m": 120.0, "cameras__base_m": 20.0, "depth_map": "low"}),
    "pair of 46 Mpx": (
        "stereo",
        {
            "wall__width_m": 40.0,
            "wall__height_m": 25.0,
            "cameras": {"distance_m": 81.0, "base_m": 20.0, "width": 8256, "height": 5504},
        },
    ),
    "scanner, near": ("tls", {"wall__width_m": 8.0, "wall__height_m": 5.0, "station__distance_m": 15.0}),
    "scanner, far": ("tls", {"station__distance_m": 300.0}),
}


@pytest.mark.parametrize("name", SET_UPS)
def test_headline_table_and_curves_say_the_same(name: str) -> None:
    """The curves at the set-up's own value equal the middle of the table; the headline's block is the smallest that is seen."""
    sensor, keys = SET_UPS[name]
    size = {"wall__width_m": 20.0, "wall__height_m": 12.0} | keys
    sides = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    config = configure(None, sensor, wall__resolution_m=0.1, planning__block_size_m=sides, planning__gsd_m=0.1, **size)
    (plan,) = plans(config, prepare_site(config, sensor, KeyedRandom(config.seed)))
    table = {each.name: each.summary(plan.in_middle)["middle"] for each in plan.maps}
    assert len(plan.curves) == 3
    for curve in plan.curves:
        here = int(np.flatnonzero(curve.x == curve.at)[0])
        for side, probability in curve.probability.items():
            assert probability[here] == pytest.approx(table[f"probability_{side * 1e3:.0f}mm"], abs=0.01)
            if table["smallest_block_m"] is not None and side > 1.01 * table["smallest_block_m"]:
                assert probability[here] >= config.planning.probability
            if table["smallest_block_m"] is None or side < 0.99 * table["smallest_block_m"]:
                assert probability[here] < config.planning.probability
    assert all(np.all(values <= 1.0) for curve in plan.curves for values in curve.probability.values())
    if table["smallest_block_m"] is not None:
        assert f"sides of {100 * table['smallest_block_m']:.1f} cm exceeds" in answer(plan)


def _colours(png: bytes) -> list[tuple[int, ...]]:
    """Return the colours of a picture except white, the most frequent first."""
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).reshape(-1, 3)
    found, count = np.unique(pixels @ np.array([65536, 256, 1]), return_counts=True)
    ordered = [(int(each) // 65536, int(each) // 256 % 256, int(each) % 256) for each in found[np.argsort(-count)]]
    return [colour for colour in ordered if colour != (255, 255, 255)]


@pytest.mark.usefixtures("drawn")
def test_a_map_of_counts_has_whole_steps_and_a_constant_is_told_in_words() -> None:
    grid = Grid(0.0, 3.0, 0.1, 40, 30)
    counts = np.ones((30, 40))
    constant = _colours(map_figure(counts, grid, "cameras", "Cameras that see the wall"))
    assert constant[0] == (0xDB, 0xE6, 0xEE)  # one pale colour, on which the words are drawn
    counts[:, :20] = 2
    counts[:, 30:] = 0
    several = _colours(map_figure(counts, grid, "cameras", "Cameras that see the wall"))
    scale = figures._count_scale(np.array([0.0, 1.0, 2.0]))
    steps = {value: tuple(int(part) for part in figures.SEQUENTIAL(scale(value), bytes=True)[:3]) for value in (0, 1, 2)}
    assert len(set(steps.values())) == 3
    assert several[0] == steps[2]  # half of the map
    assert set(several[1:3]) == {steps[0], steps[1]}  # a quarter each
    np.testing.assert_array_equal(scale.boundaries, [-0.5, 0.5, 1.5, 2.5])
