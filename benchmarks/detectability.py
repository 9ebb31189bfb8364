"""Compare the detection probability of niches in `scarpsim inspect`, a closed form, with simulated observations of a flat wall.

Target: the standardised difference of each row is within +-3.3 (by chance, one row in a thousand is not). Rows at 45 degrees with
few points in a niche may exceed it: see the limits in pipeline/precision/detectability.py.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from measure import peak_memory_gb

from pipeline.planning.trials import Trials, detection_trials
from pipeline.precision.detectability import PlanningConfig
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import TriangleMesh
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.stereo.stereo_pair import StereoPair

ROUNDS, BLOCKS = 8, 150
WIDTH_M, HEIGHT_M = 16.0, 12.0
STEP_RAD = 6e-4


def flat_wall() -> TriangleMesh:
    """Return the wall z = 0 from (0, 0) to its size, as 0.25 m squares."""
    x, y = np.meshgrid(np.arange(0, WIDTH_M + 0.1, 0.25), np.arange(0, HEIGHT_M + 0.1, 0.25))
    number = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    a, b, c, d = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, 1:].ravel(), number[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return TriangleMesh(np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3), faces)


def scanner(wall: TriangleMesh, aside_m: float, **noise: float) -> LaserScanner:
    """At 50 m in front of the wall's middle, `aside_m` to the right."""
    middle, up = np.array([WIDTH_M / 2, HEIGHT_M / 2, 0.0]), np.array([0.0, 1.0, 0.0])
    position = middle + np.array([aside_m, 0.0, 50.0])
    forward = (middle - position) / np.linalg.norm(middle - position)
    station = position, np.stack([forward, np.cross(up, forward), up], axis=1)
    config = ScannerConfig(azimuth_step_rad=STEP_RAD, zenith_step_rad=STEP_RAD)
    model = TlsModel(noise={"range_sigma_m": 0.0, "angle_sigma_rad": 0.0, **noise})
    return LaserScanner.aimed(station, WallFrame.identity(), wall.vertices, config, model)


def stereo(wall: TriangleMesh, **noise: float) -> StereoPair:
    frame = WallFrame(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.zeros(3))
    rig = RigConfig(distance_m=50.0, base_m=12.0, width=1840, height=1228)
    model = StereoModel(noise={"parallax_sigma_px": 0.0, "regularization_sigma_px": 0.0, **noise})
    return StereoPair(rig.place(Target(replace(wall, vertices=frame.to_world(wall.vertices)))), frame, model, "high")


def main() -> None:
    wall, config = flat_wall(), PlanningConfig()
    rough = {"range_sigma_m": 0.06}
    fine, coarse = ({"range_sigma_m": 0.05, "angle_sigma_rad": sigma} for sigma in (1e-4, 4e-4))
    smooth = {"parallax_sigma_px": 0.1, "regularization_sigma_px": 2.0, "regularization_step_px": 24.0}
    cases = [
        *(("tls, square", scanner(wall, 0.0, **rough), side, 0.1, BLOCKS) for side in (0.07, 0.1, 0.13)),
        *(("tls, 45 deg aside", scanner(wall, 50.0, **rough), side, 0.1, BLOCKS) for side in (0.1, 0.15, 0.2)),
        *(("tls, square, 0.4 mrad", scanner(wall, 0.0, **coarse), side, 0.1, BLOCKS) for side in (0.07, 0.1, 0.13)),
        *(("tls, 45 deg, 0.1 mrad", scanner(wall, 50.0, **fine), side, 0.1, BLOCKS) for side in (0.15, 0.2)),
        *(("stereo, white", stereo(wall, parallax_sigma_px=0.6), side, 0.1, BLOCKS) for side in (0.1, 0.13, 0.16)),
        *(("stereo, smooth", stereo(wall, **smooth), side, 1.2, 30) for side in (0.2, 0.3, 0.4)),
    ]
    print(f"{'set-up':<26}{'block':>8}{'blocks':>8}{'predicted':>11}{'simulated':>11}{'score':>8}{'seconds':>9}")
    for number, (name, sensor, side, apart, count) in enumerate(cases):
        start = time.perf_counter()
        keys = [KeyedRandom(1000 + number).child("round", index) for index in range(ROUNDS)]
        rounds = [detection_trials(sensor, wall, side, config, key, count, apart) for key in keys]
        predicted, detected = (np.concatenate([getattr(each, key) for each in rounds]) for key in ("predicted", "detected"))
        trials = Trials(predicted, detected)
        figures = f"{len(predicted):>8}{predicted.mean():>11.3f}{detected.mean():>11.3f}{trials.score():>8.2f}"
        print(f"{name:<26}{side:>6.2f} m{figures}{time.perf_counter() - start:>9.1f}")
    print(f"peak memory {peak_memory_gb():.2f} GB")


if __name__ == "__main__":
    main()
