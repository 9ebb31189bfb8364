"""The scanning pattern found from raw points: the project's own scanner, a tilted scan made here, and real scans.

The real data lie beside the checkout (`shared/`, also available to continuous integration); tests of them are skipped, with a
message that names the path, where that folder is missing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from surfaces import heightfield

from pipeline.formats.measurements.scan_geometry import ScanGeometry, polar, recover_pattern
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz, write_laz
from pipeline.formats.points.points import read_points
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner, Pattern, ScannerConfig
from sensors.models.sensor_model import TlsModel
from sensors.signal_chain.observation import Observation

SHARED = Path(__file__).parents[3] / "shared"
FOREST = SHARED / "data" / "tls_forest_vz400i" / "TLS_scan.npz"
MEASUREMENTS = SHARED / "measurements"
LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Scanner to wall frame: the scanner's x axis is -z, its z axis y."""
POSITION = np.array([0.3, -0.2, 50.0])


def scan(noise_m: float = 0.0, centre: float = 0.0) -> tuple[Observation, Pattern]:
    """Return a scan of 300 x 200 directions of a rough wall before empty sky; `centre`: azimuth of its middle, rad."""
    wall = heightfield(30.0, 20.0, 0.5)
    mesh = wall.with_vertices(wall.vertices - [15.0, 10.0, 0.0])
    pattern = Pattern(centre - 0.36, 0.0024, 300, np.pi / 2 - 0.25, 0.0025, 200)
    model = TlsModel(noise={"range_sigma_m": noise_m, "angle_sigma_rad": noise_m / 50})
    turn = Rotation.from_rotvec([0, 0, -centre]).as_matrix()
    scanner = LaserScanner(POSITION, LEVEL @ turn, pattern, ScannerConfig(), model)
    return scanner.observe(RayCaster(mesh), KeyedRandom(1)), pattern


def assert_pattern(found: ScanGeometry, seen: Observation, pattern: Pattern, points: np.ndarray, atol: float) -> None:
    """Assert steps, starts and every point's row and column; rows and columns without a return at the edge cannot be known."""
    line, pulse = np.nonzero(seen.valid)
    first_line, first_pulse = line.min(), pulse.min()
    np.testing.assert_array_equal(found.line, (line - first_line)[points])
    np.testing.assert_array_equal(found.pulse, (pulse - first_pulse)[points])
    assert found.lines.step == pytest.approx(pattern.azimuth_step, abs=atol / 300)
    assert found.pulses.step == pytest.approx(pattern.zenith_step, abs=atol / 200)
    start = pattern.azimuth_start + first_line * pattern.azimuth_step
    assert (found.lines.start - start + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0, abs=atol)
    assert found.pulses.start == pytest.approx(pattern.zenith_start + first_pulse * pattern.zenith_step, abs=atol)
    np.testing.assert_allclose(found.range_m, seen.depth[seen.valid][points], atol=1e-5)


@pytest.mark.parametrize("noise_m", [0.0, 0.01])
@pytest.mark.parametrize("centre", [0.0, 3.1])
def test_our_own_scan_gives_back_its_pattern(noise_m: float, centre: float) -> None:
    """Recorded directions are nominal whatever the noise, so the pattern is found to rounding; also across azimuth = pi."""
    seen, pattern = scan(noise_m, centre)
    rotation = LEVEL @ Rotation.from_rotvec([0, 0, -centre]).as_matrix()
    found = recover_pattern(seen.points[seen.valid], POSITION, rotation)
    assert_pattern(found, seen, pattern, np.arange(seen.valid.sum()), atol=1e-11)
    assert (found.tilt, found.synchronous) == (0.0, True)
    assert found.line_shape.tolist() == [0.0, 0.0, 0.0]
    assert max(found.azimuth_rms, found.zenith_rms) < 1e-12


def test_the_pattern_is_found_in_shuffled_half_empty_points_with_second_echoes() -> None:
    seen, pattern = scan()
    rng = np.random.default_rng(3)
    points = rng.permutation(seen.valid.sum())[: seen.valid.sum() // 2]
    kept = seen.points[seen.valid][points]
    echoes = kept[:500] + 0.4 * (kept[:500] - POSITION) / np.linalg.norm(kept[:500] - POSITION, axis=1, keepdims=True)
    found = recover_pattern(np.concatenate([kept, echoes]), POSITION, LEVEL)
    np.testing.assert_array_equal(found.line[-500:], found.line[:500])
    np.testing.assert_array_equal(found.pulse[-500:], found.pulse[:500])
    line, pulse = np.nonzero(seen.valid)
    assert found.lines.step == pytest.approx(pattern.azimuth_step, abs=1e-13)
    assert (
        np.ptp(found.line - line[np.append(points, points[:500])]),
        np.ptp(found.pulse - pulse[np.append(points, points[:500])]),
    ) == (0, 0)
    assert found.returned.sum() == len(kept)


def test_the_pattern_survives_a_laz_file(tmp_path: Path) -> None:
    """Coordinates are in whole micrometres at 50 m: 1e-8 rad each, 1e-9 in the start over 30,000 points."""
    seen, pattern = scan(0.003)
    write_laz(tmp_path / "a.laz", PointCloud(seen.points[seen.valid]))
    found = recover_pattern(read_laz(tmp_path / "a.laz").points, POSITION, LEVEL)
    assert_pattern(found, seen, pattern, np.arange(seen.valid.sum()), atol=1e-9)
    assert found.azimuth_rms < 1e-8


def tilted_scan(rng: np.random.Generator) -> tuple[FloatArray, np.ndarray, np.ndarray, FloatArray]:
    """Make a full circle like a turning head with a running mirror: tilted, with slanted lines, each with its own first zenith.

    Returns points in the level frame rounded to 1 mm, line, pulse, and the rotation of the axis's frame to the level one.
    """
    line, pulse = (grid.ravel() for grid in np.meshgrid(np.arange(400), np.arange(500), indexing="ij"))
    zenith = np.radians(30) + np.radians(0.2) * (pulse + rng.uniform(0, 1, 400)[line])
    azimuth = 1.0 + np.radians(0.899) * line + 0.004 * (zenith - np.pi / 2) + 0.002 / np.sin(zenith) + 0.001 / np.tan(zenith)
    distance = 12 + 6 * np.sin(3 * azimuth) * np.sin(2 * zenith)
    direction = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)
    rotation = Rotation.from_rotvec([0.02, -0.01, 0.0]).as_matrix()
    kept = (rng.uniform(size=line.size) < 0.6) & ((zenith > 0.9) | (np.sin(azimuth) > 0))  # an empty patch of sky
    points = np.round(distance[:, None] * direction @ rotation.T, 3)
    return points[kept], line[kept], pulse[kept], rotation


def test_a_tilted_scan_gives_back_its_axis_lines_and_steps() -> None:
    """1 mm of rounding at 6 to 18 m is 25 urad of noise in each angle; 100,000 points give axis and steps far more precisely."""
    points, line, pulse, rotation = tilted_scan(np.random.default_rng(5))
    found = recover_pattern(points)
    assert np.degrees(found.lines.step) == pytest.approx(0.899, abs=1e-6)
    assert np.degrees(found.pulses.step) == pytest.approx(0.2, abs=1e-6)
    np.testing.assert_allclose(found.rotation[:, 2], rotation[:, 2], atol=3e-6)
    assert found.tilt == pytest.approx(np.hypot(0.02, 0.01), abs=3e-6)
    assert not found.synchronous
    assert found.lines.count == 400
    assert np.mean(found.line == line) > 0.9999
    begins = np.array([np.median((found.pulse - pulse)[line == number]) for number in range(400)])
    assert np.mean(found.pulse - pulse == begins[line]) == 1.0
    assert np.ptp(begins) <= 1, "a line's first zenith lies anywhere within a step"
    assert max(found.azimuth_rms * np.sin(0.6), found.zenith_rms) < 50e-6
    np.testing.assert_allclose(polar(points @ found.rotation)[2], found.zenith, atol=1e-12)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.random.default_rng(1).normal(size=(20_000, 3)) * [9, 9, 2], "on no regular pattern"),
        (np.zeros((10, 3)), "10 points are too few"),
        (np.full((1000, 3), np.nan), "not numbers"),
        (np.repeat([[10.0, 1.0, 2.0], [10.0, 1.2, 2.1]], 500, axis=0), "on no regular pattern"),
        (np.linspace(5, 15, 1000)[:, None] * [1.0, 0.2, 0.1], "on no regular pattern"),
        (np.random.default_rng(1).uniform(size=(1000, 3)) * [9, 0, 2], "on no regular pattern"),
    ],
)
def test_points_without_a_pattern_are_named(points: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        recover_pattern(points)


def test_an_origin_that_is_off_shows_in_the_residuals() -> None:
    """An error of 0.5 m at 50 m bends the pattern of a nearly flat wall by a tenth of a milliradian; with the right origin only
    rounding remains.
    """
    seen, _ = scan()
    points = seen.points[seen.valid]
    off = recover_pattern(points, POSITION + np.array([0.5, 0.0, 0.0]), LEVEL)
    assert np.hypot(off.azimuth_rms, off.zenith_rms) > 1e-4


@pytest.mark.skipif(not FOREST.exists(), reason=f"the real scan is not there: {FOREST}")
def test_a_real_scan_has_the_documented_pattern() -> None:
    """The pattern of a RIEGL VZ-400i scan in a forest is as its README documents it.

    Coordinates have 1 mm, ranges 1 to 15 m. The scan has 580 lines, steps of 0.622 x 0.048 deg, zenith angles from 30 to 130.024
    deg, and a roll of 1.026 and a pitch of 0.746 deg. RIEGL scanners fire about 1 % faster than nominal, so the true zenith step
    is that much smaller than the documented one.
    """
    data = np.load(FOREST)
    found = recover_pattern(np.stack([data[axis] for axis in "XYZ"], axis=1))
    assert found.lines.count == 580
    assert np.degrees(found.lines.step) == pytest.approx(0.622, abs=0.0015)
    assert np.degrees(found.pulses.step) == pytest.approx(0.048, rel=0.01)
    assert np.degrees(found.pulses.start) == pytest.approx(30.0, abs=0.05)
    ends = [found.zenith[found.line == number].max() for number in range(0, 580, 5)]
    assert np.degrees(np.median(ends)) == pytest.approx(130.024, abs=0.1), "two pulses"
    documented = np.degrees(np.arccos(np.cos(np.radians(1.026)) * np.cos(np.radians(0.746))))
    assert np.degrees(found.tilt) == pytest.approx(documented, abs=0.02)
    assert found.azimuth_rms < found.lines.step / 20
    assert np.degrees(found.zenith_rms) < 0.008, "1 mm of rounding at 4 m and more"
    cell = found.line.astype(np.int64) * found.pulses.count + found.pulse
    first, second = (cell[(data["Target_count"] == 2) & (data["Target_index"] == index)] for index in (1, 2))
    assert np.isin(second, first).mean() > 0.88, (
        "echoes of a pulse in one cell; 0.25 by chance, and near points miss theirs by one"
    )
    assert np.isin(second + found.pulses.count, first).mean() < 0.35, "the next line holds the same echoes"


@pytest.mark.skipif(not MEASUREMENTS.exists(), reason=f"the measurements are not there: {MEASUREMENTS}")
@pytest.mark.parametrize("name", ["tls_no_effect", "tls_one_effect", "tls_outside_catalogue"])
def test_a_measurement_has_the_pattern_it_states(name: str) -> None:
    """Made by an independent generator in the documented form; stated to 12 decimals."""
    stated = yaml.safe_load((MEASUREMENTS / name / "measurement.yaml").read_text())
    found = recover_pattern(read_points(MEASUREMENTS / name / stated["points"]).points)
    for key, values in found.pattern.items():
        np.testing.assert_allclose(values, stated["pattern"][key], rtol=0, atol=2e-12)
    assert found.tilt == 0.0
