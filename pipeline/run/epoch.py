"""Make one epoch, read from top to bottom: carve, observe, mesh, register, rasterise, difference, annotate."""

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
from pipeline.run.acquisition import Acquisition, acquire, reconstruct
from pipeline.run.displacement import displacement
from pipeline.run.reference import reference_and_target, reference_sensor
from pipeline.run.site import SensorSite
from scene.blocks.block import Blocks, place_blocks
from scene.blocks.carve import Carved, block_records, carve
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, FloatArray, IntArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.models.placement import check_in_front


@dataclass(frozen=True)
class ReferenceEpoch:
    """The first epoch, of the untouched wall, with which all later ones are compared.

    Attributes
    ----------
    seen : Acquisition, optional
        What the sensor recorded; None once it is written, which frees its memory.
    caster : RayCaster
        The untouched wall.
    surface : TriangleMesh
        The reconstructed surface.
    raster : SurfaceRaster
        The surface as a raster; every difference map has its grid.
    target : ReferenceSurface, optional
        The surface to which epochs are registered.
    """

    seen: Acquisition | None
    caster: RayCaster
    surface: TriangleMesh
    raster: SurfaceRaster
    target: ReferenceSurface | None


@dataclass(frozen=True)
class LaterEpoch:
    """A later epoch.

    Attributes
    ----------
    number : int
        Number of the epoch, from 1.
    seen : Acquisition
        What the sensor recorded.
    carved : Carved
        The wall without the blocks.
    solids : Blocks
        The blocks.
    blocks : list of dict
        Records of the carved blocks, with what the difference map shows of each.
    surface : TriangleMesh
        The reconstructed surface before registration.
    registration : Registration, optional
        Registration of the surface to the reference; None without ICP.
    raster : SurfaceRaster
        The registered surface.
    difference : (h, w) float32 array
        Reference minus epoch, m.
    statistics : BlockStatistics
        Statistics of the difference map.
    m3c2 : M3c2Map, optional
        Distances of the registered surface's vertices, if the config asks for them.
    since_last : SinceLast, optional
        Change since the epoch before, in a series.
    rockfalls : int
        Number of rockfalls of a series, from which its block labels follow (scene/series/evolution.py); 0 without a series.
    """

    number: int
    seen: Acquisition
    carved: Carved
    solids: Blocks
    blocks: list[dict[str, Any]]
    surface: TriangleMesh
    registration: Registration | None
    raster: SurfaceRaster
    difference: NDArray[np.float32]
    statistics: BlockStatistics
    m3c2: M3c2Map | None = None
    since_last: SinceLast | None = None
    rockfalls: int = 0


@dataclass(frozen=True)
class SinceLast:
    """Change since the epoch before. difference: (h, w) that epoch minus this one, m; block: (h, w) labels of what is new."""

    difference: NDArray[np.float32]
    block: IntArray


@dataclass(frozen=True)
class EpochScene:
    """The wall that a later epoch observes.

    Attributes
    ----------
    carved : Carved
        The wall without the blocks.
    solids : Blocks
        The blocks.
    records : list of dict
        Records of the blocks, in the order of their labels.
    labels : int
        Largest label of a missing block.
    """

    carved: Carved
    solids: Blocks
    records: list[dict[str, Any]]
    labels: int


STAGES = {"carve": 4.0, "observe": 3.0, "mesh": 1.0, "register": 4.0, "difference": 2.0, "write": 8.0}
"""The stages of an epoch and their approximate weights, for the estimate of the remaining time."""


def observe_reference(config: SimulationConfig, site: SensorSite, random: KeyedRandom, progress: Progress) -> ReferenceEpoch:
    """Observe the untouched wall, reconstruct it and rasterise it. `random` is the run's source."""
    with progress.stage("epoch 0: observe"):
        caster = site.caster_of(with_wetness(config, site.mesh))
        for where, viewpoint in site.viewpoints.items():
            check_in_front(caster, viewpoint, where)
        seen = acquire(config, reference_sensor(config, site), caster, random.child("epoch", 0, "observe"))
    with progress.stage("epoch 0: mesh"):
        found, keyed = reconstruct(config, seen), random.child("epoch", 0, "register")
        surface, target = reference_and_target(config, found, caster.mesh, keyed)
    with progress.stage("epoch 0: difference"):
        raster = surface_raster(surface, raster_grid(surface.bounds, config.difference))
    return ReferenceEpoch(seen, caster, surface, raster, target)


def observe_epoch(
    config: SimulationConfig, site: SensorSite, reference: ReferenceEpoch, number: int, random: KeyedRandom, progress: Progress
) -> LaterEpoch:
    """Simulate a later epoch: carve blocks from the untouched wall, observe it and compare it with the reference.

    The result is a pure function of config, site and (seed, number); it does not depend on other epochs.

    Parameters
    ----------
    config : SimulationConfig
        Config of the run.
    site : SensorSite
        Wall and sensor.
    reference : ReferenceEpoch
        The reference epoch.
    number : int
        Number of the epoch, from 1.
    random : KeyedRandom
        The run's source of random numbers.
    progress : Progress
        Receives the progress.
    """
    with progress.stage(f"epoch {number}: carve"):
        blocks = place_blocks(config.rockfall, site.mesh, random.child("epoch", number, "blocks"), reference.caster)
        carved = carve(site.mesh, blocks)
        records = block_records(blocks, carved.removed_volume_m3)
    return observe_scene(config, site, reference, number, EpochScene(carved, blocks, records, len(records)), random, progress)


def observe_scene(
    config: SimulationConfig,
    site: SensorSite,
    reference: ReferenceEpoch,
    number: int,
    scene: EpochScene,
    random: KeyedRandom,
    progress: Progress,
) -> LaterEpoch:
    """Observe a wall at a later epoch and compare it with the reference.

    Parameters
    ----------
    config : SimulationConfig
        Config of the run.
    site : SensorSite
        The sensor.
    reference : ReferenceEpoch
        The reference epoch.
    number : int
        Number of the epoch, from 1.
    scene : EpochScene
        The wall, and what is missing from it.
    random : KeyedRandom
        The run's source of random numbers.
    progress : Progress
        Receives the progress.
    """
    keyed, blocks, records = random.child("epoch", number), scene.solids, scene.records
    carved = replace(scene.carved, mesh=with_wetness(config, scene.carved.mesh))
    with progress.stage(f"epoch {number}: observe"):
        after = RayCaster(carved.mesh)
        seen = acquire(config, site, after, keyed.child("observe"))
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
        measured = measure_blocks(change, raster, signal_to_noise(change, raster.block, lost, scene.labels))
        statistics = block_statistics(change, raster.block)
        clouds = None
        if config.m3c2 is not None:
            clouds = m3c2(reference.surface.vertices, registered.vertices, reference.raster, raster.block, config.m3c2)
    found = [
        {**record, "world_position_m": to_world(site, record["position_m"]), **measured[record["label"] - 1]}
        for record in records
    ]
    return LaterEpoch(number, seen, carved, blocks, found, surface, registration, raster, change, statistics, clouds)


def with_wetness(config: SimulationConfig, mesh: TriangleMesh) -> TriangleMesh:
    """Return the wall as sensors see it: with wet patches if the config has them."""
    return mesh if config.wetness is None else config.wetness.with_wet_patches(mesh)


def measure_blocks(change: NDArray[np.float32], raster: SurfaceRaster, ratio: FloatArray) -> list[dict[str, Any]]:
    """Measure what the difference map shows of each block: area (of its label, with data), volume and mean depth, SI.

    The volume is the sum of the differences over the label's pixels, times the area of a pixel.

    Parameters
    ----------
    change : (h, w) array
        Difference map, m.
    raster : SurfaceRaster
        Labels of the map.
    ratio : (k,) array
        Signal-to-noise ratios of the matched filter, which are added to the records.
    """
    count = len(ratio)
    seen = (raster.block != WALL) & ~np.isnan(change)
    label, depth = np.minimum(raster.block[seen], count + 1), change[seen].astype(np.float64)
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
    """Convert a position (3,), m, from the wall frame of `site` to world coordinates."""
    world: FloatArray = site.frame.to_world(np.array(position))
    return world.tolist()
