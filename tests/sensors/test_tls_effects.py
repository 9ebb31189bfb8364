"""Every effect of the laser scanner against its equation, in NumPy, through the whole scanner on a slanting plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from surfaces import heightfield, plane, step
from test_tls import POSITION, QUIET, ROTATION, SIGNIFICANCE, scan, scanner

from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import DEFAULT_ALBEDO
from scene.ray_casting.raycast import RayCaster
from sensors.effects import TLS_EFFECTS
from sensors.laser.tls import LaserScanner
from sensors.models.sensor_model import TlsModel
from sensors.signal_chain.observation import Observation

NORMAL = np.array([0.5, 0.4, 1.0]) / np.linalg.norm([0.5, 0.4, 1.0])
NOISY = {"range_sigma_m": 0.002, "range_ppm": 20.0, "angle_sigma_rad": 5e-5}
RANDOM_EFFECTS = [
    {"name": "range_noise_incidence", "sigma_m": 0.002},
    {"name": "range_noise_intensity", "a_m": 0.001, "exponent": -0.7},
    {"name": "precipitation", "rate_per_m": 1e-3, "early_share": 0.5},
]
SYSTEMATIC_EFFECTS = [
    {"name": "range_offset", "offset_m": 0.003},
    {"name": "range_scale", "scale_ppm": 20.0},
    {"name": "range_cyclic", "amplitude_m": 0.002, "period_m": 0.9},
    {"name": "range_incidence_bias", "coefficient_m": 0.002},
    {"name": "vertical_index", "offset_rad": 1e-4},
    {"name": "collimation", "angle_rad": 1e-4},
    {"name": "trunnion_tilt", "angle_rad": 1e-4},
    {"name": "horizontal_eccentricity", "amplitude_rad": 1e-4},
    {"name": "vertical_eccentricity", "amplitude_rad": 1e-4},
    {"name": "beam_divergence", "divergence_rad": 3e-4, "mode": "mean", "sub_rays": 7},
    {"name": "detection_limit", "minimum_power": 0.5},
]


@dataclass(frozen=True)
class Oracle:
    """The plane through the origin, as an ideal scanner at the tests' position sees it in nominal directions (NumPy, float64)."""

    sensor: LaserScanner

    @cached_property
    def line(self) -> np.ndarray:
        return np.arange(self.sensor.pattern.lines)[:, None] + 0.0 * np.arange(self.sensor.pattern.pulses)

    @cached_property
    def azimuth(self) -> np.ndarray:
        return self.sensor.pattern.azimuth_start + self.sensor.pattern.azimuth_step * self.line

    @cached_property
    def zenith(self) -> np.ndarray:
        pulse = np.arange(self.sensor.pattern.pulses) + 0.0 * self.line
        return self.sensor.pattern.zenith_start + self.sensor.pattern.zenith_step * pulse

    @cached_property
    def share(self) -> np.ndarray:
        return np.arange(self.line.size).reshape(self.line.shape) / (self.line.size - 1)

    def range_towards(self, direction: np.ndarray) -> np.ndarray:
        return -(POSITION @ NORMAL) / (direction @ ROTATION.T @ NORMAL)

    @cached_property
    def range_m(self) -> np.ndarray:
        return self.range_towards(unit(self.azimuth, self.zenith))

    @cached_property
    def cos_incidence(self) -> np.ndarray:
        return -(unit(self.azimuth, self.zenith) @ ROTATION.T @ NORMAL)

    @cached_property
    def power(self) -> np.ndarray:
        return DEFAULT_ALBEDO * self.cos_incidence * (100.0 / self.range_m) ** 2


def unit(azimuth: np.ndarray, zenith: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)


def look(effects: list[dict[str, Any]], noise: dict[str, float] | None = None, seed: int = 1) -> tuple[Observation, Oracle]:
    """Return a scan of the slanting plane, which fills the whole window, and what NumPy computes for it."""
    mesh = plane(NORMAL, np.zeros(3), half_side=200.0)
    return scan(mesh, noise, seed, effects=effects), Oracle(scanner())


@pytest.mark.parametrize(
    ("entry", "error"),
    [
        (
            {"name": "range_cyclic", "amplitude_m": 0.002, "period_m": 0.7, "phase_rad": 0.3},
            lambda oracle: 0.002 * np.sin(2 * np.pi * oracle.range_m / 0.7 + 0.3),
        ),
        (
            {"name": "range_intensity_bias", "coefficient_m": -0.01},
            lambda oracle: -0.01 * np.log(oracle.power / np.median(oracle.power)),
        ),
        (
            {"name": "range_intensity_bias", "coefficient_m": -0.01, "reference_power": 0.2},
            lambda oracle: -0.01 * np.log(oracle.power / 0.2),
        ),
        ({"name": "range_incidence_bias", "coefficient_m": 0.003}, lambda oracle: 0.003 * (1 / oracle.cos_incidence - 1)),
        (
            {"name": "range_quantization", "step_m": 0.004},
            lambda oracle: 0.004 * np.round(oracle.range_m / 0.004) - oracle.range_m,
        ),
    ],
    ids=lambda value: value["name"] if isinstance(value, dict) else "",
)
def test_a_range_effect_adds_its_equation(entry: dict[str, Any], error: Callable[[Oracle], np.ndarray]) -> None:
    """To 10 nm, because incidence and power are traced in float32."""
    seen, oracle = look([entry])
    np.testing.assert_allclose(seen.depth - oracle.range_m, error(oracle), atol=1e-8)
    assert np.abs(error(oracle)).max() > 1e-3


@pytest.mark.parametrize(
    ("entry", "azimuth_error", "zenith_error"),
    [
        ({"name": "vertical_index", "offset_rad": 2e-4}, lambda oracle: 0.0, lambda oracle: 2e-4),
        ({"name": "collimation", "angle_rad": 2e-4}, lambda oracle: 2e-4 / np.sin(oracle.zenith), lambda oracle: 0.0),
        ({"name": "trunnion_tilt", "angle_rad": 5e-4}, lambda oracle: 5e-4 / np.tan(oracle.zenith), lambda oracle: 0.0),
        (
            {"name": "horizontal_eccentricity", "amplitude_rad": 2e-4, "phase_rad": 0.4},
            lambda oracle: 2e-4 * np.sin(oracle.azimuth + 0.4),
            lambda oracle: 0.0,
        ),
        (
            {"name": "vertical_eccentricity", "amplitude_rad": 2e-4, "phase_rad": 0.4},
            lambda oracle: 0.0,
            lambda oracle: 2e-4 * np.sin(oracle.zenith + 0.4),
        ),
        (
            {"name": "wobble", "amplitude_rad": 2e-4, "lines_per_cycle": 33.0, "phase_rad": 0.4},
            lambda oracle: 0.0,
            lambda oracle: 2e-4 * np.sin(2 * np.pi * oracle.line / 33.0 + 0.4),
        ),
        (
            {"name": "angle_empirical", "along": {"low": -4.0, "high": 4.0}, "values_rad": [[-8e-4, 8e-4]]},
            lambda oracle: 2e-4 * oracle.azimuth,
            lambda oracle: 0.0,
        ),
        (
            {
                "name": "angle_empirical",
                "angle": "zenith",
                "covariate": "zenith",
                "along": {"low": -4.0, "high": 4.0},
                "values_rad": [[-8e-4, 8e-4]],
            },
            lambda oracle: 0.0,
            lambda oracle: 2e-4 * oracle.zenith,
        ),
    ],
    ids=lambda value: value["name"] if isinstance(value, dict) else "",
)
def test_an_angle_effect_is_recorded_minus_true(entry: dict[str, Any], azimuth_error: Any, zenith_error: Any) -> None:
    """The point lies in the nominal direction; its range is that of the true direction, nominal minus error, to a nanometre."""
    seen, oracle = look([entry])
    emitted = unit(oracle.azimuth - azimuth_error(oracle), oracle.zenith - zenith_error(oracle))
    np.testing.assert_allclose(seen.depth, oracle.range_towards(emitted), atol=1e-9)
    nominal = unit(oracle.azimuth, oracle.zenith) @ ROTATION.T
    np.testing.assert_allclose(seen.points, POSITION + seen.depth[..., None] * nominal, atol=1e-9)
    assert np.abs(seen.depth - oracle.range_m).max() > 1e-3


@pytest.mark.parametrize("entry", ["collimation", "trunnion_tilt"])
def test_axis_errors_turn_their_sign_in_the_second_face(entry: str) -> None:
    """The mean of both faces, a point seen at (az, z) and at (az + pi, 2 pi - z), is free of them to second order."""
    mesh, effects = plane(NORMAL, np.zeros(3), half_side=200.0), [{"name": entry, "angle_rad": 5e-4}]
    first = scanner(effects=effects)
    pattern = first.pattern
    second = replace(
        pattern,
        azimuth_start=pattern.azimuth_start + np.pi,
        zenith_start=2 * np.pi - pattern.zenith_start,
        zenith_step=-pattern.zenith_step,
    )
    depths = [replace(first, pattern=face).observe(RayCaster(mesh), KeyedRandom(1)).depth for face in (pattern, second)]
    truth = Oracle(first).range_m
    assert np.abs(depths[0] - truth).max() > 5e-3
    np.testing.assert_allclose((depths[0] + depths[1]) / 2, truth, atol=1e-4)  # R c^2 (1 + 2 tan^2 i)


def test_tilt_drift_turns_the_recorded_directions_as_the_scan_goes_on() -> None:
    """Compared with rotation matrices, true = R(-w) recorded; the effect is of first order in w = 5e-5: 1e-7 m at 50-80 m."""
    rates = np.array([5e-5, -3e-5, 0.0])
    seen, oracle = look([{"name": "tilt_drift", "rate_x_rad": rates[0], "rate_y_rad": rates[1]}])
    turn = Rotation.from_rotvec(-oracle.share.reshape(-1, 1) * rates)
    emitted = turn.apply(unit(oracle.azimuth, oracle.zenith).reshape(-1, 3)).reshape(*oracle.line.shape, 3)
    np.testing.assert_allclose(seen.depth, oracle.range_towards(emitted), atol=5e-7)
    assert np.abs(seen.depth - oracle.range_m).max() > 1e-3


@pytest.mark.parametrize(
    ("entry", "sigma"),
    [
        ({"name": "range_noise_incidence", "sigma_m": 0.002}, lambda oracle: 0.002 * (1 / oracle.cos_incidence - 1)),
        ({"name": "range_noise_intensity", "a_m": 0.001, "exponent": -0.5}, lambda oracle: 0.001 * oracle.power**-0.5),
        ({"name": "range_noise_intensity", "a_m": 0.001, "exponent": -1.0}, lambda oracle: 0.001 / oracle.power),
    ],
)
def test_noise_has_its_spread_at_every_pulse(entry: dict[str, Any], sigma: Callable[[Oracle], np.ndarray]) -> None:
    """Standardised errors are N(0, 1), independent along the lines and across them."""
    seen, oracle = look([entry])
    score = (seen.depth - oracle.range_m) / sigma(oracle)
    assert stats.kstest(score.ravel(), "norm").pvalue > SIGNIFICANCE
    for first, second in ((score[:-1], score[1:]), (score[:, :-1], score[:, 1:])):
        correlation = np.corrcoef(first.ravel(), second.ravel())[0, 1]
        assert abs(correlation) < stats.norm.isf(SIGNIFICANCE / 2) / np.sqrt(first.size)


def test_different_noises_are_independent() -> None:
    errors = []
    for entry in ({"name": "range_noise_incidence", "sigma_m": 0.002}, {"name": "range_noise_intensity", "a_m": 0.001}):
        seen, oracle = look([entry])
        errors.append((seen.depth - oracle.range_m).ravel())
    scores = [stats.rankdata(error) for error in errors]
    assert abs(np.corrcoef(scores)[0, 1]) < stats.norm.isf(SIGNIFICANCE / 2) / np.sqrt(scores[0].size)


def test_quantization_counts_the_noisy_range_wherever_it_stands_in_the_config() -> None:
    noise = {"name": "range_noise_incidence", "sigma_m": 0.002}
    counter = {"name": "range_quantization", "step_m": 0.005}
    analogue, _ = look([noise], NOISY)
    for effects in ([counter, noise], [noise, counter]):
        counted, _ = look(effects, NOISY)
        np.testing.assert_allclose(counted.depth, 0.005 * np.round(analogue.depth / 0.005), atol=1e-12)


def test_the_detection_limit_cuts_by_the_range_equation() -> None:
    limit = 0.9
    seen, oracle = look([{"name": "detection_limit", "minimum_power": limit}])
    clear = np.abs(oracle.power / limit - 1) > 1e-6  # power is traced in float32
    np.testing.assert_array_equal(seen.valid[clear], (oracle.power >= limit)[clear])
    assert 0.1 < seen.valid.mean() < 0.9


def test_precipitation_loses_and_shortens_returns_as_its_equations_say() -> None:
    """Losses and early returns agree within their binomial variances, the drops' ranges with their distribution from 1 m to the
    wall.
    """
    rate, share = 0.005, 0.4
    seen, oracle = look([{"name": "precipitation", "rate_per_m": rate, "early_share": share}])
    lost_chance = -np.expm1(-2 * rate * oracle.range_m)
    early = seen.valid & (seen.depth < oracle.range_m - 1e-9)
    for chance, happened in ((lost_chance * share, early), (lost_chance * (1 - share), ~seen.valid)):
        score = (happened - chance).sum() / np.sqrt((chance * (1 - chance)).sum())
        assert abs(score) < stats.norm.isf(SIGNIFICANCE / 2)
    kept = seen.valid & ~early
    np.testing.assert_allclose(seen.depth[kept], oracle.range_m[kept], atol=1e-9)
    nearest = scanner().config.minimum_range_m
    within = np.expm1(-2 * rate * (seen.depth - nearest)) / np.expm1(-2 * rate * (oracle.range_m - nearest))
    assert stats.kstest(within[early], "uniform").pvalue > SIGNIFICANCE


def test_the_order_of_a_config_changes_nothing() -> None:
    """The points agree to the rounding of summed errors, the returns exactly: random numbers are keyed by the effects' names."""
    effects = [*SYSTEMATIC_EFFECTS, *RANDOM_EFFECTS, {"name": "wobble", "amplitude_rad": 1e-4}]
    effects += [{"name": "tilt_drift", "rate_x_rad": 1e-4}, {"name": "range_intensity_bias", "coefficient_m": 0.005}]
    first, _ = look(effects, NOISY)
    for seed in (1, 2):
        shuffled, _ = look([effects[i] for i in np.random.default_rng(seed).permutation(len(effects))], NOISY)
        np.testing.assert_array_equal(shuffled.valid, first.valid)
        np.testing.assert_allclose(shuffled.points, first.points, atol=1e-9)


def test_all_effects_at_their_null_leave_the_bytes_alone() -> None:
    entries = [{"name": effect.model_fields["name"].default, **effect.nulls()} for effect in TLS_EFFECTS]
    bare, _ = look([], NOISY)
    nulls, _ = look(entries, NOISY)
    assert nulls.points.tobytes() == bare.points.tobytes()


@pytest.mark.parametrize("start", [0.0, 0.5, 0.3])
def test_a_window_scanned_alone_gives_the_points_of_the_whole_scan(start: float) -> None:
    """Wherever the pattern starts between two steps of the instrument; directions agree to rounding, 1e-12 m here."""
    mesh = heightfield(60.0, 60.0, 0.5)
    caster = RayCaster(mesh.with_vertices(mesh.vertices - [30.0, 30.0, 0.0]))
    whole = scanner(NOISY, effects=[*SYSTEMATIC_EFFECTS, *RANDOM_EFFECTS])
    shifted = replace(whole.pattern, azimuth_start=(start - 100) * whole.pattern.azimuth_step)
    window = replace(
        shifted,
        azimuth_start=shifted.azimuth_start + 37 * shifted.azimuth_step,
        zenith_start=shifted.zenith_start + 21 * shifted.zenith_step,
        lines=50,
        pulses=60,
    )
    full, alone = (replace(whole, pattern=pattern).observe(caster, KeyedRandom(3)) for pattern in (shifted, window))
    np.testing.assert_array_equal(alone.valid, full.valid[37:87, 21:81])
    np.testing.assert_allclose(alone.points, full.points[37:87, 21:81], atol=1e-8)


def test_other_effects_of_a_config_do_not_change_an_effects_random_numbers() -> None:
    alone, _ = look([], NOISY)
    beside, _ = look([{"name": "range_noise_incidence", "sigma_m": 1e-12}, {"name": "range_offset", "offset_m": 1e-12}], NOISY)
    np.testing.assert_allclose(beside.points, alone.points, atol=1e-10)


def test_an_effect_acts_at_a_step_edge_with_the_range_that_is_hit() -> None:
    seen = scan(step(1.5, 0.0), effects=[{"name": "range_cyclic", "amplitude_m": 0.002, "period_m": 4.0}])
    true_range = seen.truth["true_range_m"]
    ray = (seen.points - POSITION) / seen.depth[..., None]
    plane_z = POSITION[2] + true_range * ray[..., 2]
    assert np.minimum(np.abs(plane_z - 1.5), np.abs(plane_z))[seen.valid].max() < 1e-9
    error = 0.002 * np.sin(2 * np.pi * true_range / 4.0)
    np.testing.assert_allclose((seen.depth - true_range)[seen.valid], error[seen.valid], atol=1e-12)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        (2 * [{"name": "beam_divergence", "divergence_rad": 3e-4}], "one beam"),
        ([{"name": "beam_divergence", "sub_rays": 18}], "input should be 1, 7, 19"),
        (
            [{"name": "range_noise_intensity", "sigma_m": 0.1}],
            "belongs to range_noise, range_noise_incidence, not to range_noise_intensity",
        ),
        ([{"name": "range_cyclic", "period_m": 0}], "period_m"),
        ([{"name": "precipitation", "early_share": 1.5}], "less than or equal to 1"),
        ([{"name": "range_offset"}], "does nothing without offset_m"),
        ([{"name": "tilt_drift"}], "without rate_x_rad or rate_y_rad"),
        ([{"name": "range_cyclic", "period_m": 4.0}], "without amplitude_m"),
        ([{"name": "range_empirical", "covariate": "zenith"}], "without values_m"),
        ([{"name": "angle_empirical", "covariate": "zenith"}], "without values_rad"),
        ([{"name": "angle_empirical", "values_rad": [[0.0, 1e-4], [0.0, 1e-4]]}], "holds 2 rows"),
    ],
)
def test_wrong_effects_are_named(effects: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse(TlsModel, {"noise": QUIET, "effects": effects}, "config")


def test_an_effect_may_be_set_to_null() -> None:
    """A run's own record has nulls, and so has a config that is to be varied."""
    entry = {"name": "range_offset", "offset_m": 0}
    assert parse(TlsModel, {"effects": [entry]}, "config").effects[0].is_null
