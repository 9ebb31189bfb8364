"""The right depth map: its rays are those of the right camera, its camera errors those of the left depth map."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from surfaces import plane

from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import Camera, CameraPair, axis_rotation
from sensors.models.sensor_model import StereoModel
from sensors.signal_chain.observation import Observation
from sensors.stereo.exchanged import depth_cameras, observe_right
from sensors.stereo.stereo_pair import StereoPair

QUIET = {"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0}
FRAME = WallFrame(np.eye(3), np.zeros(3))
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])  # camera x right, y down, z forward: along -z of the wall frame
LENS = {"b1": 3.0, "b2": -2.0, "k1": -0.05, "k2": 0.03, "k3": 0.0, "k4": 0.01, "p1": 1e-3, "p2": -7e-4}


def camera(x: float, **changes: Any) -> Camera:
    plain = dict.fromkeys(LENS, 0.0)
    base = Camera(1843, 1229, 2560.0, 0.0, 0.0, **plain, position=np.array([x, 0.0, 100.0]), rotation=LOOKING_DOWN)
    return replace(base, **changes)


def both(pair: CameraPair, model: dict[str, Any], normal: tuple[float, ...] = (0, 0, 1)) -> tuple[StereoPair, list[Observation]]:
    """Return the left and the right depth map of a plane through the origin."""
    sensor = StereoPair(pair, FRAME, StereoModel(**{"noise": QUIET, **model}), "high", truth=True)
    scene = RayCaster(plane(np.array(normal, dtype=float), np.zeros(3)))
    return sensor, [sensor.observe(scene, KeyedRandom(5)), observe_right(sensor, scene, KeyedRandom(5))]


def test_a_turned_camera_reads_its_image_upside_down() -> None:
    upright = camera(3.0, cx_px=20.0, cy_px=-9.0, **LENS)
    turned = upright.turned()
    local = np.random.default_rng(1).uniform(-0.3, 0.3, (50, 2))
    points = np.concatenate([local, np.ones((50, 1))], axis=1) * 80 @ upright.rotation.T + upright.position

    def seen(by: Camera) -> FloatArray:
        x, y, z = ((points - by.position) @ by.rotation).T
        return np.stack(by.pixel(x / z, y / z), axis=1)

    np.testing.assert_allclose(seen(turned), [upright.width, upright.height] - seen(upright), atol=1e-9)
    assert np.linalg.det(turned.rotation) == pytest.approx(1)


def test_a_reduced_camera_sees_the_same_in_other_pixels() -> None:
    full = camera(0.0, cx_px=20.0, cy_px=-9.0, **LENS)
    x, y = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 50))
    small = full.reduced(4.0, 460, 307, (3.0, 1.0)).pixel(x, y)
    u, v = full.pixel(x, y)
    np.testing.assert_allclose(small, [(u - 3) / 4, (v - 1) / 4], atol=1e-9)


@pytest.mark.parametrize("lens", [dict.fromkeys(LENS, 0.0), LENS])
def test_points_lie_on_the_depth_cameras_rays_and_on_the_plane(lens: dict[str, float]) -> None:
    """The frame (1843 x 1229) is no multiple of the cell, so the right map starts at another pixel than the left one."""
    turn = axis_rotation(1, 0.05)
    pair = CameraPair(camera(-8.0, **lens, rotation=LOOKING_DOWN @ turn), camera(8.0, cx_px=12.0, rotation=LOOKING_DOWN @ turn.T))
    normal = (0.2, -0.3, 1.0)
    sensor, seen = both(pair, {}, normal)
    for observation, own in zip(seen, depth_cameras(sensor), strict=True):
        assert observation.valid.mean() > 0.5
        u, v = np.meshgrid(np.arange(own.width) + 0.5, np.arange(own.height) + 0.5)
        rays = np.stack([*own.tangents(u, v), np.ones_like(u)], axis=-1) @ own.rotation.T
        points = own.position + observation.depth[..., None] * rays
        np.testing.assert_allclose(points, observation.points, atol=1e-9)
        assert np.nanmax(np.abs(observation.points @ np.array(normal))) < 1e-6
    assert np.nanmedian(seen[1].depth) == pytest.approx(np.nanmedian(seen[0].depth), rel=0.1)


def test_both_maps_show_the_same_camera_effects() -> None:
    """Camera errors bend the plane; the right map must show the same surface as the left one, from the same random numbers."""
    pair = CameraPair(camera(-8.0, k1=-0.05), camera(8.0, k1=-0.05))
    orientation = {"phi_rad": 3e-5, "cx_px": 0.5, "k1": 1e-3, "p1": 1e-4, "x_m": 0.01}
    _, (left, right) = both(pair, {"noise": {**QUIET, "orientation": orientation}})
    x, y, z = left.points[left.valid][::7].T
    powers = [(i, j) for i in range(7) for j in range(7 - i)]

    def terms(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.stack([(x / 40) ** i * (y / 25) ** j for i, j in powers], axis=1)

    bent = np.linalg.lstsq(terms(x, y), z, rcond=None)[0]
    assert np.std(z) > 0.01
    assert np.std(z - terms(x, y) @ bent) < 2e-4
    own = right.points[right.valid][::7]
    assert np.std(own[:, 2] - terms(own[:, 0], own[:, 1]) @ bent) < 5e-4


@pytest.mark.parametrize("side", ["left", "right"])
def test_both_maps_show_the_same_exposures(side: str) -> None:
    """Row jitter in a normal pair: a row of the frame is too near or too far by dz = -dx Z^2 / (f B), equally in both maps."""
    jitter = {"name": "row_jitter", "camera": side, "amplitude_px": 0.2, "rows_per_cycle": 400.0, "phase_rad": 0.7}
    _, seen = both(CameraPair(camera(-8.0), camera(8.0)), {"effects": [jitter]})
    first_row = (0.0, 1229.0 - 2 * 614)  # the left map's cells begin at the frame's first row, the right map's end at its last
    sign = -1 if side == "left" else 1
    for observation, start in zip(seen, first_row, strict=True):
        row = start + 2 * (np.arange(614) + 0.5)
        dx = 0.2 * np.sin(2 * np.pi * row / 400 + 0.7)
        expected = 100 / (1 - sign * dx * 100 / (2560 * 16)) - 100
        np.testing.assert_allclose(np.nanmean(observation.depth - 100, axis=1), expected, atol=1e-6)


def test_matching_errors_are_drawn_anew() -> None:
    """The correlation of 100,000 independent pairs exceeds 0.02 with a probability of 1e-9."""
    noise = {"parallax_sigma_px": 0.3, "regularization_sigma_px": 0.0}
    _, (left, right) = both(CameraPair(camera(-8.0), camera(8.0)), {"noise": noise})
    shift = round(16.0 / 100 * 2560 / 2)  # disparity in cells: the cell of the right map that sees the same place
    one, other = left.depth[:, shift:] - 100, right.depth[:, :-shift] - 100
    known = np.isfinite(one) & np.isfinite(other)
    assert known.sum() > 100_000
    assert abs(np.corrcoef(one[known], other[known])[0, 1]) < 0.02
    assert np.nanstd(right.depth) == pytest.approx(np.nanstd(left.depth), rel=0.03)
