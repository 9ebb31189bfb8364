"""Received power: extinction in hazy air and wet rock against closed forms; without them nothing changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surfaces import heightfield, plane
from test_tls import scanner

from scene.appearance.wetness import WetnessConfig
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import DEFAULT_ALBEDO, FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.laser.atmosphere import extinction_per_m
from sensors.laser.tls import ScannerConfig
from sensors.signal_chain.observation import Observation

TILTED = plane(np.array([0.3, 0.5, 1.0]), np.zeros(3))


def seen(mesh: TriangleMesh = TILTED, effects: tuple[dict[str, float | str], ...] = (), **settings: float | None) -> Observation:
    sensor = replace(scanner(effects=effects), config=ScannerConfig(**settings))
    return sensor.observe(RayCaster(mesh), KeyedRandom(1))


@pytest.mark.parametrize(
    ("visibility_km", "at_785_nm", "at_1550_nm", "digits"),
    [(0.05, 340, 340, 0), (0.2, 85, 85, 0), (0.5, 34, 34, 0), (1, 14, 10, 0), (2, 7, 4, 0), (4, 3, 2, 0), (23, 0.5, 0.2, 1)],
)
def test_extinction_is_kims_table(visibility_km: float, at_785_nm: float, at_1550_nm: float, digits: int) -> None:
    """Kim et al. (2001), attenuation by fog and haze in dB/km as printed, that is 10 sigma / ln 10, rounded."""
    for wavelength_nm, printed in ((785, at_785_nm), (1550, at_1550_nm)):
        found = extinction_per_m(visibility_km * 1e3, wavelength_nm) * 1e3 * 10 / np.log(10)
        assert round(found, digits) == printed


@pytest.mark.parametrize("visibility_m", [200.0, 800.0, 3e3, 2e4, 1e5])
def test_at_550_nm_two_per_cent_of_the_contrast_are_left_at_the_visibility(visibility_m: float) -> None:
    assert np.exp(-extinction_per_m(visibility_m, 550.0) * visibility_m) == pytest.approx(0.02, rel=1e-3)


def test_haze_weakens_every_echo_by_the_two_way_transmittance_and_moves_none() -> None:
    clear, hazy = seen(), seen(visibility_m=300.0, wavelength_nm=905.0)
    assert hazy.points.tobytes() == clear.points.tobytes()
    expected = clear.intensity * np.exp(-2 * 3.912 / 300.0 * clear.depth)  # fog: q = 0
    np.testing.assert_allclose(hazy.intensity, expected, rtol=2e-6)


def test_the_detection_limit_cuts_the_range_in_haze() -> None:
    """Returns end where rho cos i (100 / R)^2 exp(-2 sigma R) falls below the limit."""
    limit = 0.5
    clear, hazy = seen(), seen(visibility_m=300.0, effects=({"name": "detection_limit", "minimum_power": limit},))
    power = clear.intensity * np.exp(-2 * 3.912 / 300.0 * clear.depth)
    doubtful = np.abs(power / limit - 1) < 1e-5
    np.testing.assert_array_equal(hazy.valid[~doubtful], (power >= limit)[~doubtful])
    assert 0.1 < hazy.valid.mean() < 0.9


def test_clear_air_is_the_default_and_changes_nothing() -> None:
    assert ScannerConfig().extinction_per_m == 0
    far = seen(visibility_m=1e15)
    np.testing.assert_allclose(far.intensity, seen().intensity, rtol=1e-6)


def test_a_visibility_of_zero_is_refused() -> None:
    with pytest.raises(InputError, match="visibility_m"):
        parse(ScannerConfig, {"visibility_m": 0}, "test")


def cloud(count: int = 200_000, reach_m: float = 4000.0) -> FloatArray:
    return np.random.default_rng(1).uniform(-reach_m, reach_m, (count, 3))


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5, 0.9])
def test_the_share_of_wet_rock_is_the_configs(share: float) -> None:
    """Points in many patches: within 5 standard errors of a binomial count, at most 6e-7 false failures; fringes are half wet."""
    wet = WetnessConfig(share=share, patch_m=0.5).wetness(cloud())
    assert np.mean(wet > 0.5) == pytest.approx(share, abs=5 * np.sqrt(share * (1 - share) / 2e5) + 5 * 0.5 / np.sqrt(2**18))


def test_wet_rock_is_darker_by_the_factor_and_dry_rock_as_it_was() -> None:
    wall = heightfield(40.0, 30.0, 0.1)
    albedo = np.random.default_rng(2).uniform(0.2, 0.8, len(wall.vertices)).astype(np.float32)
    config = WetnessConfig(share=0.4, albedo_factor=0.35)
    wet, after = config.wetness(wall.vertices), config.with_wet_patches(replace(wall, vertex_albedo=albedo)).vertex_albedo
    np.testing.assert_array_equal(after[wet == 0], albedo[wet == 0])
    np.testing.assert_allclose(after[wet == 1], 0.35 * albedo[wet == 1], rtol=1e-6)
    assert min((wet == 0).mean(), (wet == 1).mean()) > 0.1
    np.testing.assert_allclose(config.with_wet_patches(wall).vertex_albedo[wet == 1], 0.35 * DEFAULT_ALBEDO, rtol=1e-6)


def test_patches_are_smooth_and_fixed_in_space() -> None:
    """Part of the wall in another order has the same patches; another seed has others.

    Slopes are bounded by those of the smoothsteps: 1.5 of the lattice's range, 2 / 0.37 deviations, per patch; 1.5 / 0.2 per
    deviation.
    """
    config, points = WetnessConfig(), cloud(20_000, 30.0)
    wet = config.wetness(points)
    np.testing.assert_array_equal(config.wetness(points[::-7]), wet[::-7])
    assert np.abs(config.wetness(np.add(points, [0.01, 0, 0])) - wet).max() < 0.01 / 4 * 1.5 * 2 / 0.37 * 1.5 / 0.2
    assert np.mean((WetnessConfig(seed=2).wetness(points) > 0.5) != (wet > 0.5)) > 0.2


def test_intensity_falls_with_the_albedo_and_the_points_stay() -> None:
    mesh = heightfield(40.0, 30.0, 0.25, roughness=0.0)
    mesh = mesh.with_vertices(mesh.vertices - [20.0, 15.0, 0.0])
    dry, wet = seen(mesh), seen(WetnessConfig(share=1.0, albedo_factor=0.5).with_wet_patches(mesh))
    assert wet.points.tobytes() == dry.points.tobytes()
    np.testing.assert_allclose(wet.intensity, 0.5 * dry.intensity, rtol=1e-6)


@pytest.mark.parametrize("config", [WetnessConfig(share=0.0), WetnessConfig(albedo_factor=1.0)])
def test_without_water_the_mesh_is_the_same_object(config: WetnessConfig) -> None:
    assert config.with_wet_patches(TILTED) is TILTED
