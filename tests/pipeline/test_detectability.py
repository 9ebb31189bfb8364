"""The detection probability of blocks, against exact distributions and against niches that the simulated sensors observe."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats
from surfaces import heightfield

from pipeline.planning.trials import Trials, detection_trials
from pipeline.precision.detectability import (
    CLEAR_SNR,
    PlanningConfig,
    Sampling,
    detection_probability,
    smallest_block,
    smallest_clear_block,
)
from pipeline.precision.surface import Places
from pipeline.precision.tls_geometry import tls_geometry
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import TriangleMesh
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.stereo.stereo_pair import StereoPair

PLAN = PlanningConfig()
LIMIT = stats.norm.isf(1e-4)
"""Of a standardised number of detections: a false-failure rate of 2e-4 for each of the 9 cases; seeds are fixed."""
FLAT = heightfield(12.0, 8.0, 0.25, roughness=0.0)
FRAME = WallFrame(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.zeros(3))
SQUARE, OBLIQUE = np.array([6.0, 4.0, 50.0]), np.array([36.0, 4.0, 40.0])


def scanner(position: np.ndarray, step_rad: float = 6e-4, **noise: float) -> LaserScanner:
    forward = (
        (np.array([6.0, 4.0, 0.0]) - position) * [1, 0, 1] / np.linalg.norm((np.array([6.0, 4.0, 0.0]) - position) * [1, 0, 1])
    )
    up = np.array([0.0, 1.0, 0.0])
    station = position, np.stack([forward, np.cross(up, forward), up], axis=1)
    config = ScannerConfig(azimuth_step_rad=step_rad, zenith_step_rad=step_rad)
    model = TlsModel(noise={"range_sigma_m": 0.0, "angle_sigma_rad": 0.0, **noise})
    return LaserScanner.aimed(station, WallFrame.identity(), FLAT.vertices, config, model)


def stereo(**noise: float) -> StereoPair:
    rig = RigConfig(distance_m=50.0, base_m=12.0, width=1840, height=1228)
    world = TriangleMesh(FRAME.to_world(FLAT.vertices), FLAT.faces)
    model = StereoModel(noise={"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0, **noise})
    return StereoPair(rig.place(Target(world)), FRAME, model, "high")


def sampling(**changes: Any) -> Sampling:
    values = {"step_a": 0.02, "step_b": 0.02, "shadow_a": 0.0, "shadow_b": 0.0, "white": 0.01, **changes}
    return Sampling(**{name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in values.items()})


def together(trials: list[Trials]) -> Trials:
    predicted, detected = ([getattr(trial, name) for trial in trials] for name in ("predicted", "detected"))
    return Trials(np.concatenate(predicted), np.concatenate(detected))


@pytest.mark.parametrize("position", [SQUARE, OBLIQUE], ids=["square", "oblique"])
@pytest.mark.parametrize("side", [0.07, 0.10, 0.13])
def test_the_scanner_detects_as_many_niches_as_predicted(side: float, position: np.ndarray) -> None:
    """200 niches each; the probabilities lie between 0.01 and 0.9, and the binomial interval is +-0.13 wide at 0.5."""
    sensor = scanner(position, range_sigma_m=0.06)
    trials = together([detection_trials(sensor, FLAT, side, PLAN, KeyedRandom(seed), count=100) for seed in (11, 12)])
    assert abs(trials.score()) < LIMIT


def test_beams_that_leave_in_another_direction_than_recorded_miss_the_floor_near_its_edge() -> None:
    """0.4 mrad are 2 cm at 50 m; without beams that miss, the prediction would be 0.92 instead of 0.64."""
    sensor = scanner(SQUARE, range_sigma_m=0.05, angle_sigma_rad=4e-4)
    trials = together([detection_trials(sensor, FLAT, 0.12, PLAN, KeyedRandom(seed), count=100) for seed in (31, 32)])
    assert abs(trials.score()) < LIMIT


@pytest.mark.parametrize(
    ("noise", "side", "apart"),
    [
        ({"parallax_sigma_px": 0.6}, 0.13, 0.1),
        ({"parallax_sigma_px": 0.1, "regularization_sigma_px": 2.0, "regularization_step_px": 24.0}, 0.25, 1.2),
    ],
    ids=["white", "smooth"],
)
def test_the_stereo_pair_detects_as_many_niches_as_predicted(noise: dict[str, float], side: float, apart: float) -> None:
    """Niches further apart than two nodes of the smooth noise are independent."""
    seeds, count = ((21, 22), 80) if apart < 1 else (range(21, 27), 16)
    sensor = stereo(**noise)
    trials = together([detection_trials(sensor, FLAT, side, PLAN, KeyedRandom(seed), count, apart) for seed in seeds])
    assert 0.1 < trials.predicted.mean() < 0.95
    assert abs(trials.score()) < LIMIT


@pytest.mark.parametrize("lines", [2, 3, 4, 10])
def test_on_a_whole_lattice_it_is_the_noncentral_t_distribution(lines: int) -> None:
    """A block that is exactly `lines` steps wide has lines^2 = N points in both epochs: Welch's test is Student's with 2 (N
    - 1).
    """
    side, points = lines * 0.02, lines**2
    white = np.linspace(0.005, 0.2, 40)
    delta = PLAN.depth_ratio * side / (white * np.sqrt(2 / points))
    expected = stats.nct.sf(PLAN.critical_value, 2 * (points - 1), delta)
    found = detection_probability(sampling(white=white, step_a=np.full(40, 0.02)), side + 1e-12, PLAN)
    np.testing.assert_allclose(found, expected, atol=0.005)


def test_for_many_points_the_change_exceeds_a_known_level_of_detection() -> None:
    side, registration, white = 0.4, 0.05, np.linspace(0.2, 3.0, 30)
    config = PlanningConfig(registration_sigma_m=registration)
    error = white * np.sqrt(2 / 400)
    limit = 1.96 * (error + registration)
    expected = stats.norm.sf((limit - 0.2) / np.hypot(error, registration))
    found = detection_probability(sampling(white=white), side + 1e-12, config)
    np.testing.assert_allclose(found, expected, atol=0.002)


def test_the_mean_of_smooth_noise_has_the_variance_of_interpolated_nodes() -> None:
    """Without white noise the change of a patch's mean is normal with variance 2 c_m^2, found here by brute force over phases and
    nodes.

    20,000 draws give a standard deviation to 0.5 %; 2.5 % holds with a false-failure rate below 1e-5.
    """
    random = np.random.default_rng(4)
    for width in (0.1, 0.7, 1.5, 4.0):
        at = random.random(20_000)[:, None] + np.linspace(0, width, 200)
        nodes = random.normal(size=(20_000, 8))
        left = np.floor(at).astype(int)
        rows = np.arange(20_000)[:, None]
        means = (nodes[rows, left] * (1 - at + left) + nodes[rows, left + 1] * (at - left)).mean(axis=1)
        from_formula = np.sqrt(2 / 3 * kept_variance(width))
        assert means.std() == pytest.approx(from_formula, rel=0.025)


def kept_variance(width: float) -> float:
    """Return c_m^2 over c^2 for a patch of `width` nodes along a and none along b, from the probability of a change of 1.

    With negligible white noise and spread (N is huge), P = Phi(h / sqrt(2 c_m^2)).
    """
    side = 1.0
    grains = sampling(step_a=1e-5, step_b=1e-5, white=1e-9, smooth=1.0, grain_a=side / width, grain_b=1e9)
    probability = detection_probability(grains, side, PLAN)
    return float(0.5 * (PLAN.depth_ratio * side / stats.norm.ppf(probability[0])) ** 2)


def test_a_block_of_the_smallest_size_is_seen_with_the_probability_asked_for() -> None:
    cases = sampling(white=[0.003, 0.01, 0.05], step_a=[0.02, 0.03, 0.1], step_b=[0.02, 0.05, 0.1], shadow_a=[0.0, 0.5, 1.0])
    side = smallest_block(cases, PLAN)
    np.testing.assert_allclose(detection_probability(cases, side, PLAN), PLAN.probability, atol=0.01)
    assert (detection_probability(cases, side * 0.99, PLAN) < PLAN.probability).all()


def test_the_smallest_findable_block_is_that_of_the_closed_form() -> None:
    """White noise w on a lattice a x b: S/N = r s^2 / (w sqrt(2 a b)), with r = depth over side, and at least one point on the
    block.
    """
    white, a, b = np.array([0.003, 0.01, 0.05]), np.array([0.02, 0.03, 0.1]), np.array([0.02, 0.05, 0.1])
    cases = sampling(white=white, step_a=a, step_b=b, shadow_a=0.0, shadow_b=0.0)
    expected = np.sqrt(CLEAR_SNR * white * np.sqrt(2 * a * b) / PLAN.depth_ratio)
    np.testing.assert_allclose(smallest_clear_block(cases, PLAN), np.maximum(expected, np.sqrt(a * b)), rtol=2e-3)


def test_a_floor_that_the_rim_hides_is_never_seen() -> None:
    hidden = sampling(shadow_a=2.0 / PLAN.depth_ratio)
    assert detection_probability(hidden, 5.0, PLAN)[0] == 0
    assert np.isnan(smallest_block(hidden, PLAN)[0])
    assert np.isnan(smallest_clear_block(hidden, PLAN)[0])


def test_the_points_on_a_block_are_its_area_times_the_cosine_over_the_squared_spacing() -> None:
    sensor = scanner(OBLIQUE, range_sigma_m=0.01)
    places = Places(np.array([[6.0, 4.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([0.5]))
    found = tls_geometry(sensor, places).sampling
    sight = places.points[0] - OBLIQUE
    spacing = 6e-4 * np.linalg.norm(sight)
    cosine = -sight[2] / np.linalg.norm(sight)
    assert 0.2**2 / (found.step_a * found.step_b)[0] == pytest.approx(0.2**2 * cosine / spacing**2, rel=1e-9)
    assert found.shadow_a[0] == pytest.approx(30.0 / 40.0)
    assert found.shadow_b[0] == pytest.approx(0.0, abs=1e-12)


def test_from_aside_and_below_the_rim_of_an_upright_niche_hides_what_both_tangents_say() -> None:
    """The block is 20 m above the scanner, 30 m to its side and 40 m away, where lines of equal zenith run obliquely over the
    wall.
    """
    sensor = scanner(OBLIQUE, range_sigma_m=0.01)
    places = Places(np.array([[6.0, 24.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([0.5]))
    found = tls_geometry(sensor, places).sampling
    assert found.shadow_a[0] == pytest.approx(30.0 / 40.0)
    assert found.shadow_b[0] == pytest.approx(20.0 / 40.0)
    assert found.step_b[0] == pytest.approx(6e-4 * (30**2 + 40**2 + 20**2) / 50)  # d(h cot z) = h / sin^2 z dz
    assert found.step_a[0] == pytest.approx(6e-4 * 50**2 / 40)  # d(40 tan az) = 40 / cos^2 az daz


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"probability": 1.0}, "'probability': input should be less than 1"),
        ({"minimum_points": 1}, "'minimum_points'"),
        ({"block_size_m": []}, "'block_size_m'"),
        ({"block_size_m": [-0.2]}, "'block_size_m"),
        ({"block_size_m": [1e300]}, "less than or equal to 30"),
        ({"block_size_m": [0.2, 1e-9]}, "greater than or equal to 0.001"),
        ({"gsd": 0.1}, "unknown key 'gsd'; did you mean 'gsd_m'?"),
    ],
)
def test_a_wrong_planning_section_is_one_clear_error(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message.replace("?", r"\?")):
        parse(PlanningConfig, values, "planning")
