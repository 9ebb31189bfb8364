"""Observing only some cells or pulses gives the same values there as observing all."""

from __future__ import annotations

import numpy as np
from surfaces import heightfield
from test_stereo import FRAME, rig
from test_tls import scanner

from scene.common.keyed_random import KeyedRandom
from scene.ray_casting.raycast import RayCaster
from sensors.models.sensor_model import StereoModel
from sensors.stereo.stereo_pair import StereoPair
from sensors.subset import effects_needing_neighbours, restrict_to

EFFECTS = (
    {"name": "camera_omega", "angle_rad": 1e-4},
    {"name": "row_jitter", "amplitude_px": 0.2, "rows_per_cycle": 31.0},
    {"name": "pixel_locking", "amplitude_px": 0.1},
)


def wall() -> RayCaster:
    rough = heightfield(40.0, 30.0, 0.25)
    return RayCaster(rough.with_vertices(rough.vertices - [20.0, 15.0, 0.0]))


def test_chosen_cells_are_those_of_the_whole_depth_map() -> None:
    noise = {"parallax_sigma_px": 0.3, "regularization_sigma_px": 0.1, "orientation": {"f_px": 0.5}}
    pair = StereoPair(rig(), FRAME, StereoModel(noise=noise, effects=EFFECTS), "medium")
    assert not effects_needing_neighbours(pair.model)
    caster = wall()
    whole = pair.observe(caster, KeyedRandom(3))
    chosen = np.random.default_rng(1).permutation(whole.depth.size)[:5000].astype(np.uint32)
    some = restrict_to(pair, chosen).observe(caster, KeyedRandom(3))
    assert some.valid.sum() > 1000
    for part, every in ((some.points, whole.points), (some.depth, whole.depth), (some.offset, whole.offset)):
        expected = every.reshape(whole.depth.size, -1)[chosen]
        np.testing.assert_array_equal(part.reshape(len(chosen), -1), expected)


def test_chosen_pulses_are_those_of_the_whole_scan() -> None:
    whole_scanner, caster = scanner({"range_sigma_m": 0.003, "angle_sigma_rad": 5e-5}), wall()
    whole = whole_scanner.observe(caster, KeyedRandom(3))
    chosen = np.random.default_rng(1).permutation(whole.depth.size)[:2000].astype(np.uint32)
    some = restrict_to(whole_scanner, chosen).observe(caster, KeyedRandom(3))
    assert some.valid.sum() > 500
    np.testing.assert_array_equal(some.points.reshape(-1, 3), whole.points.reshape(-1, 3)[chosen])


def test_effects_that_look_at_neighbours_are_told() -> None:
    model = StereoModel(effects=({"name": "smoothing", "sigma_px": 3.0}, *EFFECTS))
    assert effects_needing_neighbours(model) == ["smoothing"]
