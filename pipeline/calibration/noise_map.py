"""Simulate difference maps of noise alone, by the whole pipeline: nothing falls between two observations of one wall."""

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
    """Return a site whose stereo pair has another sensor model, to simulate how noise changes with the model.

    site: the wall and its sensor. model: noise and effects of the pair from now on. Raises InputError if the sensor is not a
    stereo pair with simulated matching.
    """
    if not isinstance(site.sensor, StereoPair):
        raise InputError(
            "a map of the noise under another sensor model needs a stereo pair with simulated matching",
            where="sensor, matcher",
            remedy="use the stereo sensor with matcher: simulated",
        )
    return replace(site, sensor=replace(site.sensor, model=model))


def noise_map(
    config: SimulationConfig,
    before: SensorSite,
    after: SensorSite,
    caster: RayCaster,
    random: KeyedRandom,
    grid: Grid | None = None,
) -> NDArray[np.float32]:
    """Simulate the difference map of two observations of an unchanged wall, which contains only noise.

    Both observations draw independent noise. The second is registered to the first if the config has ICP.

    Parameters
    ----------
    config : Settings of surface, registration and difference map.
    before, after : The same site at the first and at the second observation; their sensors may differ in model or pose.
    caster : The wall, for ray casting.
    random : Source of the random numbers.
    grid : Grid of the map; None: a grid over the first observation's surface.

    Returns
    -------
    (h, w) differences, first minus second observation along the wall frame's z axis, m; NaN without data.
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
    """Observe the wall and reconstruct its surface."""
    return reconstruct(config, acquire(config, site, caster, random))
