"""The laser beam's footprint against closed forms on planes and edges, and against a slow implementation in NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from surfaces import heightfield, plane, step
from test_tls import POSITION, ROTATION, scan, scanner

from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import DEFAULT_ALBEDO, FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner, Pattern
from sensors.signal_chain.beam import unit_offsets
from sensors.signal_chain.observation import Observation

LIGHT = 299_792_458.0
TERRACES = [(-40.0, -0.55, 0.0), (-0.55, -0.45, 3.0), (-0.45, 0.1, 1.0), (0.1, 0.3, 1.3), (0.3, 0.35, 2.4), (0.5, 40.0, 2.6)]
"""(x from, x to, z), m: planes of constant z, with steps below and above the pulse's length and a gap between two."""


def beam(divergence: float = 3e-4, **parameters: Any) -> list[dict[str, Any]]:
    return [{"name": "beam_divergence", "divergence_rad": divergence, **parameters}]


@pytest.mark.parametrize("count", [7, 19, 37, 61, 91])
def test_sub_rays_have_the_moments_of_the_gaussian(count: int) -> None:
    """Zero mean, D^2/16 about both axes, none mixed; beyond the second moments, six-fold symmetry."""
    x, y = unit_offsets(count).T
    assert len(x) == count
    np.testing.assert_allclose([x.mean(), y.mean(), (x * y).mean()], 0.0, atol=1e-15)
    np.testing.assert_allclose([(x**2).mean(), (y**2).mean()], 1 / 16, rtol=1e-12)
    turned = (x + 1j * y) * np.exp(1j * np.pi / 3)
    assert np.abs(turned[:, None] - (x + 1j * y)).min(axis=1).max() < 1e-12


@pytest.mark.parametrize(("count", "worst", "typical"), [(7, 0.22, 0.08), (19, 0.11, 0.035), (37, 0.07, 0.025), (61, 0.05, 0.02)])
def test_a_straight_edge_cuts_off_the_gaussians_energy(count: int, worst: float, typical: float) -> None:
    """The error stays within the stated bounds, for edges in all directions, compared with the error function."""
    offsets, edges = unit_offsets(count), np.linspace(-1.0, 1.0, 801)
    for angle in np.linspace(0.0, np.pi, 90):
        across = offsets @ [np.cos(angle), np.sin(angle)]
        error = (across < edges[:, None]).mean(axis=1) - stats.norm.cdf(edges * 4)
        assert np.abs(error).max() < worst
        assert np.sqrt(np.mean(error**2)) < typical


@pytest.mark.parametrize("mode", ["first", "strongest", "mean"])
def test_on_a_tilted_plane_the_range_is_the_axiss_to_second_order(mode: str) -> None:
    """The power p ~ cos i / R^2 of the Gaussian's parts gives R (1 - s^2 (2 tan^2 i - 1)), s = D / 4 per axis, to 0.1 um.

    The echoes of one plane are one return in every mode, though they spread over 0.2 m.
    """
    divergence, normal = 2e-3, np.array([0.8, 0.5, 1.0]) / np.linalg.norm([0.8, 0.5, 1.0])
    mesh = plane(normal, np.zeros(3), half_side=300.0)
    seen, axis = scan(mesh, effects=beam(divergence, mode=mode), lines=60, pulses=60), scan(mesh, lines=60, pulses=60)
    tan_squared = axis.truth["cos_incidence"].astype(float) ** -2 - 1
    expected = -axis.depth * (divergence / 4) ** 2 * (2 * tan_squared - 1)
    np.testing.assert_allclose(seen.depth - axis.depth, expected, atol=1e-7)
    assert np.abs(expected).max() > 2e-5
    np.testing.assert_allclose(seen.intensity, axis.intensity, rtol=1e-4)
    np.testing.assert_allclose(seen.truth["cos_incidence"], axis.truth["cos_incidence"], rtol=1e-4)


@pytest.mark.parametrize(("count", "worst"), [(19, 0.11), (37, 0.07)])
def test_a_mixed_pixel_is_the_centroid_of_what_the_edge_leaves_on_either_side(count: int, worst: float) -> None:
    """A step of 0.3 m, within c tau / 2 = 0.45 m: the split by the error function to the sub-rays' bound, without bias over the
    edge.
    """
    near, far, divergence = 0.3, 0.0, 2e-3
    seen = edge(step(near, far), divergence, sub_rays=count)
    expected = centroid(seen, near, far, divergence)
    error = (seen.depth - expected) / (near - far)
    assert np.abs(error).max() < worst
    assert abs(error.mean()) < 0.002
    mixed = np.abs(axis_at(seen, near)[0]) < divergence / 4 * POSITION[2]
    assert mixed.mean() > 0.1


def edge(mesh: TriangleMesh, divergence: float, **parameters: Any) -> Observation:
    """Return a fine scan across the edge at x = 0, in thirty steps over the width of the beam."""
    across, along = 300, 12
    sensor = scanner(effects=beam(divergence, **parameters))
    pattern = Pattern(0.006 - 0.003, 2e-5, across, np.pi / 2 - 0.0012, 2e-4, along)
    return scan_with(sensor, mesh, pattern)


def scan_with(sensor: LaserScanner, mesh: TriangleMesh, pattern: Pattern) -> Observation:
    return replace(sensor, pattern=pattern).observe(RayCaster(mesh), KeyedRandom(1))


def nominal(seen: Observation) -> FloatArray:
    return (seen.points - POSITION) / seen.depth[..., None]


def axis_at(seen: Observation, z: float) -> tuple[FloatArray, FloatArray]:
    """Return x of the beams' axes in a plane of constant z, m, and the ranges there."""
    ray = nominal(seen)
    range_m = (z - POSITION[2]) / ray[..., 2]
    return POSITION[0] + range_m * ray[..., 0], range_m


def centroid(seen: Observation, near: float, far: float, divergence: float) -> FloatArray:
    """Return the range of the two planes' common return: energies by the error function of the angle from axis to edge,
    over R^2.
    """
    (x, near_range), (_, far_range) = axis_at(seen, near), axis_at(seen, far)
    angle = np.arctan2(x, POSITION[2] - near)
    near_energy = stats.norm.cdf(4 * angle / divergence) / near_range**2
    far_energy = stats.norm.sf(4 * angle / divergence) / far_range**2
    return (near_energy * near_range + far_energy * far_range) / (near_energy + far_energy)


@pytest.mark.parametrize("mode", ["first", "strongest"])
def test_beyond_the_pulses_length_a_step_leaves_no_points_between(mode: str) -> None:
    near, far, divergence = 1.5, 0.0, 2e-3
    seen = edge(step(near, far), divergence, mode=mode)
    z = seen.points[..., 2]
    assert np.minimum(np.abs(z - near), np.abs(z - far)).max() < 5e-4  # R tan i D / 2: a part of the beam lies off its axis
    angle = axis_at(seen, near)[0] / POSITION[2]
    on_near = np.abs(z - near) < 0.1
    turn = 0.0 if mode == "strongest" else -np.abs(unit_offsets(19)[:, 0]).max() * divergence
    assert on_near[angle > turn + 0.1 * divergence].all()
    assert not on_near[angle < turn - 0.1 * divergence].any()


def test_the_mean_of_all_returns_does_not_care_how_far_apart_they_are() -> None:
    near, far, divergence = 1.5, 0.0, 2e-3
    seen = edge(step(near, far), divergence, mode="mean", sub_rays=37)
    assert np.abs(seen.depth - centroid(seen, near, far, divergence)).max() < 0.07 * (near - far)


def test_no_footprint_bias_on_a_rough_wall() -> None:
    """The mean over 60,000 pulses equals that of a thin beam within 0.1 mm, five times the standard error of the beam's
    smoothing.
    """
    wall = heightfield(40.0, 30.0, 0.1, roughness=0.2)
    mesh = wall.with_vertices(wall.vertices - [20.0, 15.0, 0.0])
    window = {"lines": 300, "pulses": 200, "step_rad": 0.002}
    pencil, wide = scan(mesh, **window), scan(mesh, effects=beam(3e-4, mode="mean"), **window)
    both = pencil.valid & wide.valid
    assert abs(np.mean((wide.depth - pencil.depth)[both])) < 1e-4


def test_one_sub_ray_is_the_pencil() -> None:
    mesh = heightfield(40.0, 30.0, 1.0)
    mesh = mesh.with_vertices(mesh.vertices - [20.0, 15.0, 0.0])
    pencil, single = (scan(mesh, effects=effects, lines=50, pulses=50) for effects in ([], beam(3e-4, sub_rays=1)))
    assert pencil.points.tobytes() == single.points.tobytes()


def terraces() -> TriangleMesh:
    """Return the planes of TERRACES, each labelled as a block of its own."""
    corners = [(x, y, z) for low, high, z in TERRACES for x, y in ((low, -40), (high, -40), (high, 40), (low, 40))]
    faces = np.array([[[0, 1, 2], [0, 2, 3]]]) + 4 * np.arange(len(TERRACES))[:, None, None]
    labels = np.repeat(np.arange(len(TERRACES)), 2) + 1
    return TriangleMesh(np.array(corners, dtype=float), faces.reshape(-1, 3).astype(np.int32), face_block=labels.astype(np.int32))


@dataclass(frozen=True)
class Twin:
    """What NumPy computes for one pulse: sub-ray by sub-ray on the terraces, returns by a plain loop."""

    range_m: float
    power: float
    block: int
    doubtful: bool


def twin(azimuth: float, zenith: float, divergence: float, count: int, mode: str, separation: float, wave: float | None) -> Twin:
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    axis = np.array([np.sin(zenith) * cosine, np.sin(zenith) * sine, np.cos(zenith)])
    along = np.array([[-sine, cosine, 0.0], [np.cos(zenith) * cosine, np.cos(zenith) * sine, -np.sin(zenith)]])
    rays = axis + divergence * unit_offsets(count) @ along
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ ROTATION.T
    echoes, doubtful = [], False
    for ray in rays:
        best = None
        for number, (low, high, z) in enumerate(TERRACES):
            far = (z - POSITION[2]) / ray[2]
            x = POSITION[0] + far * ray[0]
            doubtful |= min(abs(x - low), abs(x - high)) < 2e-5
            if low < x < high and (best is None or far < best[0]):
                best = far, DEFAULT_ALBEDO * -ray[2] * (100 / far) ** 2, number + 1
        if best is not None:
            echoes.append(best)
    return _returned(echoes, count, mode, separation, wave, doubtful)


def _returned(
    echoes: list[tuple[float, float, int]], count: int, mode: str, separation: float, wave: float | None, doubtful: bool
) -> Twin:
    if not echoes:
        return Twin(np.nan, np.nan, 0, doubtful)
    echoes.sort(key=lambda echo: echo[0])
    returns = [[echoes[0]]]
    for echo in echoes[1:]:
        if echo[0] - returns[-1][-1][0] <= separation:
            returns[-1].append(echo)
        else:
            returns.append([echo])
    energies = sorted((sum(echo[1] for echo in group) for group in returns), reverse=True)
    if mode == "strongest" and wave is None:
        doubtful |= len(energies) > 1 and energies[0] / energies[1] < 1 + 1e-5
    groups = {"first": returns[0], "strongest": max(returns, key=lambda group: sum(echo[1] for echo in group)), "mean": echoes}
    group = groups["mean" if wave else mode]
    ranges, powers = (np.array([echo[part] for echo in group]) for part in (0, 1))
    centre, total = float(ranges @ powers / powers.sum()), powers.sum()
    block = group[int(np.argmax(powers))][2]
    if wave:
        phasor = np.sum(powers * np.exp(4j * np.pi * (ranges - centre) / wave))
        doubtful |= np.pi - abs(np.angle(phasor)) < 1e-3 or abs(phasor) < 1e-2 * total
        return Twin(centre + wave / (4 * np.pi) * float(np.angle(phasor)), abs(phasor) / count, block, doubtful)
    return Twin(centre, total / count, block, doubtful)


@pytest.mark.parametrize("count", [7, 19])
@pytest.mark.parametrize(
    ("mode", "ranging", "width"),
    [
        ("first", "pulse", 3e-9),
        ("strongest", "pulse", 3e-9),
        ("mean", "pulse", 3e-9),
        ("strongest", "pulse", 8e-9),
        ("mean", "phase", 3e-9),
    ],
)
def test_returns_are_those_of_the_slow_twin(mode: str, ranging: str, width: float, count: int) -> None:
    """Ranges agree to 1 um, powers to 1e-4, blocks and misses exactly."""
    divergence, wave = 8e-3, 1.2
    sensor = scanner(
        effects=beam(divergence, mode=mode, ranging=ranging, sub_rays=count, pulse_width_s=width, modulation_wavelength_m=wave)
    )
    pattern = Pattern(-0.03, 1.1e-3, 40, np.pi / 2 - 0.01, 1e-3, 20)
    seen = scan_with(sensor, terraces(), pattern)
    azimuth = pattern.azimuth_start + pattern.azimuth_step * np.arange(pattern.lines)
    zenith = pattern.zenith_start + pattern.zenith_step * np.arange(pattern.pulses)
    arguments = divergence, count, mode, LIGHT * width / 2, wave if ranging == "phase" else None
    expected = [[twin(a, z, *arguments) for z in zenith] for a in azimuth]
    clear = np.array([[not pulse.doubtful for pulse in line] for line in expected])
    assert clear.mean() > 0.9
    depth, power, block = (np.array([[getattr(p, n) for p in line] for line in expected]) for n in ("range_m", "power", "block"))
    assert seen.intensity is not None
    np.testing.assert_allclose(seen.depth[clear], depth[clear], atol=1e-6)
    np.testing.assert_allclose(seen.intensity[clear], power[clear], rtol=1e-4)
    np.testing.assert_array_equal(seen.block[clear], block[clear])
