"""Estimate the detection probability by simulation, to check the closed form.

Niches in a flat wall are observed by the real sensors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from pipeline.precision.detectability import PlanningConfig, detection_probability
from pipeline.precision.stereo_geometry import stereo_geometry
from pipeline.precision.surface import BoolArray, Places
from pipeline.precision.tls_geometry import tls_geometry
from scene.blocks.block import RockfallConfig, place_blocks
from scene.blocks.carve import carve
from scene.blocks.distributions import Gaussian
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner
from sensors.models.sensor_model import StereoModel, TlsModel
from sensors.stereo.stereo_pair import StereoPair

_ON_SURFACE_M = 1e-4
"""Tolerance within which a point lies on a floor, m."""


@dataclass(frozen=True)
class Trials:
    """Hold the outcome of k simulated rockfalls, to check predicted detection probabilities.

    Attributes
    ----------
    predicted : (k,) array
        Detection probability of each block by the equations of `detection_probability`.
    detected : (k,) bool array
        Whether the simulated change of each block exceeded its level of detection.
    """

    predicted: FloatArray
    detected: BoolArray

    def score(self) -> float:
        """Return the z-score of the number of detections: observed minus predicted number, over its standard deviation.

        Values beyond about 3 in magnitude mean that the predicted probabilities are wrong. The standard deviation is that of a
        sum of independent draws with different probabilities (Poisson binomial).
        """
        variance = (self.predicted * (1 - self.predicted)).sum()
        return float((self.detected.sum() - self.predicted.sum()) / np.sqrt(max(variance, 1e-12)))


def detection_trials(
    sensor: LaserScanner | StereoPair,
    wall: TriangleMesh,
    side_m: float,
    config: PlanningConfig,
    random: KeyedRandom,
    count: int = 40,
    apart_m: float = 0.1,
) -> Trials:
    """Check predicted detection probabilities by simulation: carve cubes out of a flat wall and test for a change at each.

    Half of each cube is in the rock, so that its fall leaves a niche (a hole) of half its side in depth. The sensor
    observes the wall before and after. On the floor of each niche, the change is tested against the level of detection of
    M3C2. The points of a floor are those that would lie on it without noise, where the scanner or both cameras see it.

    Parameters
    ----------
    sensor : LaserScanner or StereoPair
        The sensor, with its noise.
    wall : TriangleMesh
        The flat wall z = 0, wall frame, m.
    side_m : float
        Side of the cubes, m.
    config : PlanningConfig
        Critical value, least number of points and registration error of the test.
    random : KeyedRandom
        Source of random numbers.
    count : int
        Number of cubes.
    apart_m : float
        Least distance between cubes, m.

    Returns
    -------
    Trials
        For each cube, the predicted probability and whether its change was detected.
    """
    blocks = place_blocks(_cubes(side_m, count, apart_m), wall, random.child("blocks"))
    centres = blocks.position_m * [1.0, 1.0, 0.0]
    low, high = _visible_floor(sensor, centres, side_m)
    casters = RayCaster(wall), RayCaster(carve(wall, blocks).mesh)

    def sample(number: int, depth: float) -> FloatArray:
        caster = casters[number]
        truth = _quiet(sensor).observe(caster, random.child("quiet")).points.reshape(-1, 3)
        seen = sensor.observe(caster, random.child("epoch", number)).points.reshape(-1, 3)
        return _statistics(seen, _block_of(truth, depth, low, high), len(centres))

    places = Places(centres, np.tile([0.0, 0.0, 1.0], (len(centres), 1)), np.full(len(centres), 0.5))
    geometry = tls_geometry(sensor, places) if isinstance(sensor, LaserScanner) else stereo_geometry(sensor, places)
    return Trials(
        detection_probability(geometry.sampling, side_m, config), _exceeding(sample(0, 0.0), sample(1, side_m / 2), config)
    )


def _cubes(side_m: float, count: int, apart_m: float) -> RockfallConfig:
    """Return the config of the blocks."""
    exact = {"rotation_rad": Gaussian(mean=0.0, sigma=0.0), "irregularity": Gaussian(mean=0.0, sigma=0.0)}
    size = Gaussian(mean=side_m, sigma=0.0)
    return RockfallConfig(count=count, shape="cube", size_m=size, minimum_distance_m=apart_m, safe_zone_offset_m=0.2, **exact)


def _quiet(sensor: LaserScanner | StereoPair) -> LaserScanner | StereoPair:
    """Return the sensor without noise."""
    if isinstance(sensor, LaserScanner):
        return replace(sensor, model=TlsModel.model_validate({"noise": {"range_sigma_m": 0, "angle_sigma_rad": 0}}))
    quiet = StereoModel.model_validate({"noise": {"parallax_sigma_px": 0, "regularization_sigma_px": 0}})
    return replace(sensor, model=quiet)


def _visible_floor(sensor: LaserScanner | StereoPair, centres: FloatArray, side_m: float) -> tuple[FloatArray, FloatArray]:
    """Return smallest and largest x, y (k, 2) of the part of each floor that all viewpoints see."""
    if isinstance(sensor, LaserScanner):
        viewpoints = [sensor.position]
    else:
        pair = sensor.cameras.in_wall_frame(sensor.frame)
        viewpoints = [pair.left.position, pair.right.position]
    sights = np.array([centres - viewpoint for viewpoint in viewpoints])
    shift = side_m / 2 * sights[:, :, :2] / -sights[:, :, 2:]
    low = centres[:, :2] - side_m / 2 + np.maximum(shift.max(axis=0), 0.0)
    return low, centres[:, :2] + side_m / 2 + np.minimum(shift.min(axis=0), 0.0)


def _block_of(truth: FloatArray, depth: float, low: FloatArray, high: FloatArray) -> IntArray:
    """Return the block (n,) whose floor, `depth` below the wall, each cell really sees; -1 for none."""
    at_depth = np.flatnonzero(np.abs(truth[:, 2] + depth) < _ON_SURFACE_M)
    place = truth[at_depth, :2]
    _, nearest = cKDTree((low + high) / 2).query(place, p=np.inf)
    inside = ((place > low[nearest]) & (place < high[nearest])).all(axis=1)
    block = np.full(len(truth), -1, dtype=np.int32)
    block[at_depth[inside]] = nearest[inside]
    return block


def _statistics(points: FloatArray, block: IntArray, count: int) -> FloatArray:
    """Return number of points, mean and variance of z of each block, (3, count)."""
    used = (block >= 0) & ~np.isnan(points[:, 2])
    label, z = block[used], points[used, 2]
    number = np.bincount(label, minlength=count)
    mean = np.bincount(label, z, count) / np.maximum(number, 1)
    variance = np.bincount(label, np.square(z - mean[label]), count) / np.maximum(number - 1, 1)
    return np.stack([number, mean, variance])


def _exceeding(before: FloatArray, after: FloatArray, config: PlanningConfig) -> BoolArray:
    """Return whether each change (k,) exceeds its level of detection (Lague et al. 2013)."""
    number = np.minimum(before[0], after[0])
    error = np.sqrt(before[2] / np.maximum(before[0], 1) + after[2] / np.maximum(after[0], 1))
    limit = config.critical_value * (error + config.registration_sigma_m)
    return (number >= config.minimum_points) & (before[1] - after[1] > limit)
