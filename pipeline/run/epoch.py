"""One epoch, read from top to bottom: carve, observe, mesh, register, rasterise, difference, annotate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.difference import BlockStatistics, SurfaceRaster, block_statistics, difference, raster_grid, surface_raster
from pipeline.change.m3c2 import M3c2Map, m3c2
from pipeline.change.matched_filter import signal_to_noise, true_change
from pipeline.config.simulation import SimulationConfig
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import Registration, register_to
from pipeline.report.progress import Progress
from pipeline.run.acquisition import Look, look, reconstruct
from pipeline.run.displacement import displacement
from pipeline.run.registered import reference_and_target, reference_sensor
from pipeline.run.site import SensorSite
from scene.blocks.block import Blocks, place_blocks
from scene.blocks.carve import Carved, block_records, carve
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.models.placement import check_in_front


@dataclass(frozen=True)
class ReferenceEpoch:
    """The first epoch, of the untouched wall: all later ones are compared with it.

    seen: what the sensor saw, None once it is written, which spares its memory; caster: the untouched wall; surface:
    reconstructed; raster: of the surface, its grid is that of every difference map; target: the surface as ICP wants it, where
    epochs are registered.
    """

    seen: Look | None
    caster: RayCaster
    surface: TriangleMesh
    raster: SurfaceRaster
    target: ReferenceSurface | None


@dataclass(frozen=True)
class LaterEpoch:
    """A later epoch.

    seen: what the sensor saw; solids: the blocks; blocks: records of what was carved, with what the difference map shows of each;
    surface: reconstructed, before registration; raster: after it; difference: (h, w) float32, m, reference minus epoch; m3c2:
    distances of the registered surface's vertices, where the config asks for them.
    """

    number: int
    seen: Look
    carved: Carved
    solids: Blocks
    blocks: list[dict[str, Any]]
    surface: TriangleMesh
    registration: Registration | None
    raster: SurfaceRaster
    difference: NDArray[np.float32]
    statistics: BlockStatistics
    m3c2: M3c2Map | None = None


STAGES = {"carve": 4.0, "observe": 3.0, "mesh": 1.0, "register": 4.0, "difference": 2.0, "write": 8.0}
"""The stages of an epoch and their rough weights for the time left."""


def observe_reference(config: SimulationConfig, site: SensorSite, random: KeyedRandom, progress: Progress) -> ReferenceEpoch:
    """Observe the untouched wall, reconstruct and rasterise it; `random` is the run's."""
    with progress.stage("epoch 0: observe"):
        caster = RayCaster(as_observed(config, site.mesh))
        for where, viewpoint in site.viewpoints.items():
            check_in_front(caster, viewpoint, where)
        seen = look(config, reference_sensor(config, site), caster, random.child("epoch", 0, "observe"))
    with progress.stage("epoch 0: mesh"):
        found, keyed = reconstruct(config, seen), random.child("epoch", 0, "register")
        surface, target = reference_and_target(config, found, caster.mesh, keyed)
    with progress.stage("epoch 0: difference"):
        raster = surface_raster(surface, raster_grid(surface.bounds, config.difference))
    return ReferenceEpoch(seen, caster, surface, raster, target)


def observe_epoch(
    config: SimulationConfig, site: SensorSite, reference: ReferenceEpoch, number: int, random: KeyedRandom, progress: Progress
) -> LaterEpoch:
    """Carve blocks from the untouched wall, observe it and compare with the reference.

    A pure function of config, site and (seed, number): the result does not depend on other epochs.
    """
    keyed = random.child("epoch", number)
    with progress.stage(f"epoch {number}: carve"):
        blocks = place_blocks(config.rockfall, site.mesh, keyed.child("blocks"), reference.caster)
        carved = carve(site.mesh, blocks)
        carved = replace(carved, mesh=as_observed(config, carved.mesh))
        records = block_records(blocks, carved.removed_volume_m3)
    with progress.stage(f"epoch {number}: observe"):
        after = RayCaster(carved.mesh)
        seen = look(config, site, after, keyed.child("observe"))
    with progress.stage(f"epoch {number}: mesh"):
        surface = reconstruct(config, seen)
    registration, registered = None, surface
    if config.icp is not None and reference.target is not None:
        with progress.stage(f"epoch {number}: register"):
            registration = register_to(reference.target, surface.vertices, config.icp, keyed.child("register"))
            registered = surface.with_vertices(registration.apply(surface.vertices))
    with progress.stage(f"epoch {number}: difference"):
        raster = surface_raster(registered, reference.raster.grid)
        shift = displacement(seen.observations, registration, raster.grid)
        raster = replace(raster, block=after.labels_down(raster.grid, shift))
        change = difference(reference.raster, raster)
        lost = true_change(reference.caster, after, raster.block, raster.grid, shift)
        measured = measure_blocks(change, raster, signal_to_noise(change, raster.block, lost, len(records)))
        statistics = block_statistics(change, raster.block)
        clouds = None
        if config.m3c2 is not None:
            clouds = m3c2(reference.surface.vertices, registered.vertices, reference.raster, raster.block, config.m3c2)
    found = [
        {**record, "world_position_m": to_world(site, record["position_m"]), **values}
        for record, values in zip(records, measured, strict=True)
    ]
    return LaterEpoch(number, seen, carved, blocks, found, surface, registration, raster, change, statistics, clouds)


def as_observed(config: SimulationConfig, mesh: TriangleMesh) -> TriangleMesh:
    """The wall in the state that sensors meet: wet where the config says so."""
    return mesh if config.wetness is None else config.wetness.with_wet_patches(mesh)


def measure_blocks(change: NDArray[np.float32], raster: SurfaceRaster, ratio: FloatArray) -> list[dict[str, Any]]:
    """What the difference map shows of each block: area (of its label, with data), volume and mean depth, SI, and the matched
    filter's signal-to-noise `ratio` (k,).

    Volume is the sum of the differences over the label's pixels times the pixel's area.
    """
    count = len(ratio)
    seen = (raster.block != WALL) & ~np.isnan(change)
    label, depth = raster.block[seen], change[seen].astype(np.float64)
    pixels = np.bincount(label, minlength=count + 1)[1 : count + 1]
    total = np.bincount(label, depth, minlength=count + 1)[1 : count + 1]
    area = raster.grid.gsd**2
    return [
        {
            "measured_area_m2": float(number * area),
            "measured_volume_m3": float(volume * area),
            "measured_mean_depth_m": float(volume / number) if number else None,
            "signal_to_noise": None if np.isnan(rho) else round(float(rho), 3),
        }
        for number, volume, rho in zip(pixels, total, ratio, strict=True)
    ]


def to_world(site: SensorSite, position: list[float]) -> list[float]:
    """A wall-frame position, m, in the wall's own (world) coordinates."""
    world: FloatArray = site.frame.to_world(np.array(position))
    return world.tolist()
