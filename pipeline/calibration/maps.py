"""Difference maps of noise alone: nothing falls between two observations of one wall, so they show the sensor's noise only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.change.difference import difference, raster_grid, surface_raster
from pipeline.config.simulation import SimulationConfig
from pipeline.registration.register import register_to
from pipeline.run.acquisition import acquire, reconstruct
from pipeline.run.reference import reference_and_target
from pipeline.run.site import SensorSite
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.models.sensor_model import StereoModel
from sensors.stereo.stereo_pair import StereoPair


def with_model(site: SensorSite, model: StereoModel) -> SensorSite:
    """The site with another model of its pair; InputError for one that is not seen by a simulated stereo pair."""
    if not isinstance(site.sensor, StereoPair):
        raise InputError("noise maps are made of simulated matching", where="matcher", remedy="take the stereo sensor")
    return replace(site, sensor=replace(site.sensor, model=model))


def noise_map(
    config: SimulationConfig,
    before: SensorSite,
    after: SensorSite,
    caster: RayCaster,
    random: KeyedRandom,
    grid: Grid | None = None,
) -> NDArray[np.float32]:
    """(h, w) differences, m, of two observations of the untouched wall (`caster`), NaN without data.

    before, after: one site, with the sensor as it is at each observation. Both draw noise of their own from `random`; the
    second is registered to the first where the config has ICP. grid: of the map; none: over the first one's surface.
    """
    surface = _surface(config, before, caster, random.child("reference"))
    reference, target = reference_and_target(config, surface, caster.mesh, random.child("register", "reference"))
    later = _surface(config, after, caster, random.child("later"))
    if config.icp is not None and target is not None:
        found = register_to(target, later.vertices, config.icp, random.child("register"))
        later = later.with_vertices(found.apply(later.vertices))
    grid = grid or raster_grid(reference.bounds, config.difference)
    return difference(surface_raster(reference, grid), surface_raster(later, grid))


def _surface(config: SimulationConfig, site: SensorSite, caster: RayCaster, random: KeyedRandom) -> TriangleMesh:
    return reconstruct(config, acquire(config, site, caster, random))
