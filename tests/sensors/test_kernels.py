"""What an empty kernel cache has to compile for a scan: few small kernels, and those of the rays whatever the effects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from kernels import kernels
from surfaces import step
from test_stereo import FRAME, rig
from test_tls import scanner

from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster
from sensors.effects import STEREO_EFFECTS, TLS_EFFECTS
from sensors.effects.base import Effect
from sensors.models.sensor_model import StereoModel
from sensors.stereo.stereo_pair import StereoPair

NOISE = {"range_sigma_m": 0.003, "angle_sigma_rad": 5e-5}


def typical(effect: type[Effect]) -> dict[str, Any]:
    return {"name": effect.tag(), **effect.typical_sizes()}


def beam(sub_rays: int, mode: str = "strongest") -> list[dict[str, Any]]:
    return [{"name": "beam_divergence", "divergence_rad": 3e-4, "sub_rays": sub_rays, "mode": mode}]


def of_scan(effects: list[dict[str, Any]], **size: int) -> dict[str, int]:
    scene = RayCaster(step(0.3, 0.0))
    return kernels(lambda: scanner(NOISE, effects=effects, **size).observe(scene, KeyedRandom(1)))


RANGES = [{"name": "range_offset", "offset_m": 0.004}, {"name": "range_scale", "scale_ppm": 20.0}]
ALL = [typical(effect) for effect in TLS_EFFECTS]
FEW = [
    typical(effect)
    for effect in TLS_EFFECTS
    if effect.tag() in ("wobble", "tilt_drift", "range_cyclic", "range_noise", "collimation")
]


@pytest.mark.parametrize(
    ("effects", "most", "operations"), [([], 6, 1600), (RANGES[:1], 6, 1600), (FEW, 6, 2100), (ALL, 9, 4000), (beam(19), 8, 1900)]
)
def test_a_scan_compiles_few_small_kernels(effects: list[dict[str, Any]], most: int, operations: int) -> None:
    """With all effects one kernel of 12,000 operations before, with 19 sub-rays one of 11,900, with 61 one of 37,300."""
    found = of_scan(effects)
    assert len(found) <= most
    assert sum(found.values()) <= operations


def test_the_rays_are_traced_by_one_kernel_whatever_the_effects_and_their_values() -> None:
    plain, other = of_scan([]), of_scan(RANGES, lines=150)
    values = of_scan([{**effect, key: 2 * value} for effect in RANGES for key, value in effect.items() if key != "name"])
    rays = max(plain, key=lambda name: plain[name])
    assert rays in other
    assert values.keys() == other.keys()


def test_beams_are_served_by_the_same_kernels_whatever_the_number_of_their_rays() -> None:
    seven, nineteen, many = (of_scan(beam(number), lines=50, pulses=40).keys() for number in (7, 19, 61))
    assert seven == nineteen == many


def test_a_cast_is_one_kernel_wherever_numpy_puts_its_arrays() -> None:
    """Memory that starts at a multiple of a packet's bytes and memory that does not were two kernels for every array."""
    found: set[str] = set()
    for points in (100, 101, 3000, 70_000):
        scene, buffer = RayCaster(step(0.3, 0.0)), np.empty(3 * points + 16)
        scene.cast(np.array([0.0, 0.0, 50.0]), np.array([[0.0, 0.0, -1.0]]))
        for start in (0, 1, 3):
            towards = buffer[start : start + 3 * points].reshape(points, 3)
            towards[:] = [0.0, 0.01, -1.0]
            found |= kernels(lambda scene=scene, towards=towards: scene.cast(np.array([0.0, 0.0, 50.0]), towards)).keys()
    assert len(found) == 1


@pytest.mark.parametrize(
    ("effects", "most", "operations"), [([], 5, 2600), ([typical(each) for each in STEREO_EFFECTS], 9, 4500)]
)
def test_a_stereo_observation_compiles_few_small_kernels(effects: list[dict[str, Any]], most: int, operations: int) -> None:
    wall = step(0.3, 0.0)
    scene = RayCaster(replace(wall, vertex_albedo=np.full(len(wall.vertices), 0.4)))
    pair = StereoPair(rig(k1=-0.05, k2=0.03), FRAME, StereoModel(effects=effects), "low")
    found = kernels(lambda: pair.observe(scene, KeyedRandom(1)))
    assert len(found) <= most
    assert sum(found.values()) <= operations
