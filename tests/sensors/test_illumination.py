"""The sun against published positions, shadows and sky against closed forms, the texture's statistics."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from surfaces import plane, step

from scene.appearance.illumination import J2000, Illumination, IlluminationConfig, sun_coordinates, sun_position
from scene.appearance.texture import TextureConfig, solid_noise
from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster

UP = np.array([0.0, 1.0, 0.0])


def test_equatorial_position_is_the_almanac_s_within_a_hundredth_of_a_degree() -> None:
    """Meeus, Astronomical Algorithms, example 25.a: 1992 October 13, 0h: apparent 198.38083 and -7.78507 deg."""
    ascension, declination = np.degrees(sun_coordinates((datetime(1992, 10, 13, tzinfo=UTC) - J2000).total_seconds() / 86400))
    assert ascension == pytest.approx(198.38083, abs=0.01)
    assert declination == pytest.approx(-7.78507, abs=0.01)


def test_position_is_that_of_the_reference_algorithm() -> None:
    """Reda & Andreas (2004), the example of NREL's SPA: zenith 50.11162 deg, azimuth 194.34024 deg, in local time."""
    local = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    for time in (local, datetime(2003, 10, 17, 19, 30, 30)):
        sun = sun_position(time, np.radians(39.742476), np.radians(-105.1786))
        assert 90 - np.degrees(sun.elevation_rad) == pytest.approx(50.11162, abs=0.01)
        assert np.degrees(sun.azimuth_rad) == pytest.approx(194.34024, abs=0.01)


def test_the_sun_stands_in_the_north_in_an_australian_noon_and_in_the_east_in_the_morning() -> None:
    """Glendale, New South Wales, at the December solstice: highest at 90 - 32.93 + 23.44 = 80.5 deg."""
    place = np.radians(-32.93), np.radians(151.65)
    day = [sun_position(datetime(2025, 12, 21, 20) + timedelta(minutes=5 * k), *place) for k in range(144)]
    highest = max(day, key=lambda sun: sun.elevation_rad)
    assert np.degrees(highest.elevation_rad) == pytest.approx(80.5, abs=0.05)
    assert abs(highest.direction[0]) < 0.01
    assert highest.direction[1] > 0
    assert day[0].direction[0] > 0.8


def test_a_sun_below_the_horizon_and_half_a_place_are_refused() -> None:
    night = IlluminationConfig(time_utc=datetime(2026, 6, 21, 0), latitude_deg=51.5, longitude_deg=0.0)
    with pytest.raises(InputError, match="below the horizon"):
        night.sun()
    with pytest.raises(ValueError, match="needed together"):
        IlluminationConfig(time_utc=datetime(2026, 6, 21, 0))


def irradiance(mesh: TriangleMesh, light: Illumination, x: FloatArray) -> FloatArray:
    """Return the irradiance of the points that vertical rays hit at (x, 0)."""
    caster = RayCaster(mesh)
    origin = mi.Array3f64(mi.Float64(x), mi.Float64(0.0), mi.Float64(50.0))
    hits = caster.intersect(origin, mi.Array3f64(0.0, 0.0, -1.0))
    point = mi.Array3f64(origin.x, origin.y, origin.z - hits.distance)
    return np.array(light.irradiance(caster, point, hits.normal))


def test_irradiance_of_an_open_plane_is_lambert_s() -> None:
    normal, sun = np.array([0.2, -0.1, 1.0]), np.array([0.6, 0.0, 0.8])
    found = irradiance(plane(normal, np.zeros(3)), Illumination(sun, UP, 0.3), np.linspace(-5, 5, 7))
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(found, 0.7 * normal @ sun + 0.3 * (1 + normal @ UP) / 2, rtol=1e-5)


def test_a_step_casts_the_shadow_of_its_height_over_the_tangent_of_the_sun() -> None:
    """The edge at x = 0 is 2 m high; the sun in the direction (0.6, 0, 0.8) leaves the ground from x = -1.5 m to the edge in
    shadow.

    A wall closes the step: without it the sun would shine in under the upper half plane.
    """
    open_step = step(2.0, 0.0)
    riser = np.array([[0.0, -40, 0], [0, 40, 0], [0, 40, 2], [0, -40, 2]])
    faces = np.concatenate([open_step.faces, [[8, 10, 9], [8, 11, 10]]]).astype(np.int32)
    mesh = TriangleMesh(np.concatenate([open_step.vertices, riser]), faces)
    x = np.array([-3.0, -1.51, -1.49, -0.1, 0.1])
    found = irradiance(mesh, Illumination(np.array([0.6, 0.0, 0.8]), UP, 0.25), x)
    np.testing.assert_allclose(found, 0.125 + 0.6 * np.array([1, 1, 0, 0, 1]), atol=1e-5)


def test_texture_has_its_contrast_and_stays_with_the_rock() -> None:
    """Noise of unit deviation: 40,000 points 20 grains apart on average are independent, so 5 sigma is 5 / sqrt(2 n) = 1.8 %."""
    points = np.random.default_rng(1).uniform(-2000, 2000, (3, 40_000))
    noise = np.array(solid_noise(mi.Array3f64(points), 0.3, 7))
    assert noise.std() == pytest.approx(1.0, abs=0.018)
    assert abs(noise.mean()) < 5 / 200
    texture = TextureConfig(contrast=0.1).texture(KeyedRandom(3))
    factor = np.array(texture.factor(mi.Array3f64(points), 0.03))
    again = np.array(texture.factor(mi.Array3f64(points[:, :100]), 0.03))
    octaves = np.log2(1.0 / 0.03)  # six whole ones, the last not fully faded in
    assert np.array_equal(factor[:100], again)
    assert np.log(factor).std() == pytest.approx(0.1 * np.sqrt(1 + octaves), rel=0.08)
    other = np.array(TextureConfig(contrast=0.1).texture(KeyedRandom(4)).factor(mi.Array3f64(points), 0.03))
    assert abs(np.corrcoef(factor, other)[0, 1]) < 5 / 200


def test_texture_is_continuous_across_its_lattice() -> None:
    x = np.arange(-1.0, 1.0, 1e-4)
    line = mi.Array3f64(mi.Float64(x), mi.Float64(0.0), mi.Float64(0.05))
    noise = np.array(solid_noise(line, 0.1, 5))
    dr.eval()
    assert np.abs(np.diff(noise)).max() < 1e-3 * 1.5 * 2 / 0.37  # steepest smoothstep 3/2 per grain between -1 and 1, normalised
