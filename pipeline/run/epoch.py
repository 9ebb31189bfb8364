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
        What the sensor recorded; None once it is written to files, which frees its memory.
    caster : RayCaster
        The true, untouched wall, ready for ray casting.
    surface : TriangleMesh
        The surface reconstructed from the measurement, wall frame.
    raster : SurfaceRaster
        The heights of this surface as a raster; every difference map has its grid.
    target : ReferenceSurface, optional
        The surface to which ICP registers later epochs; None: without registration.
    """

    seen: Acquisition | None
    caster: RayCaster
    surface: TriangleMesh
    raster: SurfaceRaster
    target: ReferenceSurface | None


@dataclass(frozen=True)
class LaterEpoch:
    """A simulated epoch after the reference: the wall after rockfalls, its measurement, and what the difference map shows.

    Attributes
    ----------
    number : int
        Number of the epoch, from 1; 0 is the reference.
    seen : Acquisition
        What the sensor recorded.
    carved : Carved
        The true wall, from which the fallen blocks are missing.
    solids : Blocks
        The fallen blocks as closed meshes.
    blocks : list of dict
        Record of each fallen block: its true shape, place and volume, and what the difference map shows of it.
    surface : TriangleMesh
        The reconstructed surface before registration, wall frame.
    registration : Registration, optional
        Registration of the surface to the reference; None without ICP.
    raster : SurfaceRaster
        Heights of the registered surface, and block labels.
    difference : (h, w) float32 array
        Heights of the reference minus those of this epoch, m; positive where rock is missing.
    statistics : BlockStatistics
        Statistics of the difference map.
    m3c2 : M3c2Map, optional
        M3C2 distances from the reference to the registered surface, if the config asks for them.
    since_last : SinceLast, optional
        Change since the epoch before, in a time series.
    rockfalls : int
        In a time series, the number n of all its rockfalls; else 0. Labels 1 to n are niches, n + 1 to 2 n moved blocks,
        and 2 n + 1 to 3 n deposits.
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
    """Change of the wall from the previous epoch of a time series to this one.

    difference: (h, w) heights of the previous epoch minus those of this one, m. block: (h, w) labels of the rocks that fell,
    moved or came to rest between the two, 0 elsewhere.
    """

    difference: NDArray[np.float32]
    block: IntArray


@dataclass(frozen=True)
class EpochScene:
    """The true wall that the sensor observes in a later epoch, and the blocks that have fallen from it.

    Attributes
    ----------
    carved : Carved
        The wall, from which the fallen blocks are missing.
    solids : Blocks
        The fallen blocks as closed meshes.
    records : list of dict
        Record of each fallen block (shape, size, volume and place), in the order of their labels.
    labels : int
        Largest label that the niche of a fallen block can have.
    """

    carved: Carved
    solids: Blocks
    records: list[dict[str, Any]]
    labels: int


STAGES = {"carve": 4.0, "observe": 3.0, "mesh": 1.0, "register": 4.0, "difference": 2.0, "write": 8.0}
"""The stages of an epoch and their approximate weights, for the estimate of the remaining time."""


def observe_reference(config: SimulationConfig, site: SensorSite, random: KeyedRandom, progress: Progress) -> ReferenceEpoch:
    """Simulate the first epoch: observe the untouched wall, reconstruct its surface and convert that to a raster of heights.

    Parameters
    ----------
    config : SimulationConfig
        Config of the run.
    site : SensorSite
        Wall and sensor.
    random : KeyedRandom
        The run's source of random numbers.
    progress : Progress
        Receives the progress.

    Raises
    ------
    InputError
        If the sensor does not stand in front of the wall or sees too little of it.
    """
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

    Its random numbers depend on the run's seed and its own number alone, so the result is the same whichever other epochs are
    made.

    Parameters
    ----------
    config : SimulationConfig
        Config of the run.
    site : SensorSite
        Wall and sensor.
    reference : ReferenceEpoch
        The first epoch.
    number : int
        Number of the epoch, from 1.
    random : KeyedRandom
        The run's source of random numbers.
    progress : Progress
        Receives the progress.

    Raises
    ------
    InputError
        If the blocks find no room on the wall, or if the measurement cannot be reconstructed or registered.
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
    """Simulate the measurement of a given wall in a later epoch, and compare it with the reference.

    Parameters
    ----------
    config : SimulationConfig
        Config of the run.
    site : SensorSite
        The sensor.
    reference : ReferenceEpoch
        The first epoch.
    number : int
        Number of the epoch, from 1.
    scene : EpochScene
        The wall of this epoch, and the blocks that are missing from it.
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
    """Return a wall with wet, darker patches of rock if the config asks for them (`wetness`), else the given mesh itself.

    mesh: the wall, wall frame.
    """
    return mesh if config.wetness is None else config.wetness.with_wet_patches(mesh)


def measure_blocks(change: NDArray[np.float32], raster: SurfaceRaster, ratio: FloatArray) -> list[dict[str, Any]]:
    """Measure the area, volume and mean depth of each fallen block in a difference map, to compare them with the truth.

    The volume of a block is the sum of the differences over the pixels with its label and with data, times the area of a pixel.

    Parameters
    ----------
    change : (h, w) array
        Difference map, m; NaN without data.
    raster : SurfaceRaster
        Gives the grid of the map and the block label of each pixel.
    ratio : (k,) array
        Signal-to-noise ratio of each of the k blocks, which is copied to the results.

    Returns
    -------
    list of k dict
        measured_area_m2, measured_volume_m3, measured_mean_depth_m (None for a block that is not in the map), and
        signal_to_noise (None if unknown).
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
