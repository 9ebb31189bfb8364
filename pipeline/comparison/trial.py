"""Simulate several sensors in front of one wall from which the same blocks fall.

Wall, blocks, raster and seed are the same for all; each sensor has its own place, noise, reconstruction and registration. The
true changes are known, so that noise can be evaluated on stable ground (10 cm from any block) and errors everywhere.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.change.difference import SurfaceRaster, cast_raster, difference, raster_grid, surface_raster
from pipeline.comparison.covariates import UntouchedWall, range_and_incidence, untouched_wall, visible
from pipeline.comparison.sensor_setups import SensorSetup
from pipeline.registration.register import register_to
from pipeline.report.progress import Progress
from pipeline.run.acquisition import Acquisition, acquire, reconstruct
from pipeline.run.epoch import with_wetness
from pipeline.run.reference import reference_and_target, reference_sensor
from pipeline.run.site import SensorSite, prepare_site
from scene.blocks.block import RockfallConfig, place_blocks
from scene.blocks.carve import block_records, carve
from scene.blocks.distributions import Gaussian
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL, FloatArray, IntArray
from scene.ray_casting.raycast import RayCaster
from sensors.models.placement import check_in_front

Raster = NDArray[np.float32]
_MARGIN_M = 0.1
"""Distance of stable ground from blocks, m; larger than the blur of a reconstruction."""
_LEAST_CHANGE_M = 1e-4
"""Smaller true changes, m, are rounding errors of the ray caster."""
_CROWDING = 0.15
"""Largest share of the wall that the blocks of an epoch, with the space around them, may take."""
_SIZE_SPREAD, _SMALLEST_SHARE = 0.15, 0.5
"""Standard deviation and minimum of the block sizes of an epoch, as shares of their mean."""


@dataclass(frozen=True)
class TrueEpoch:
    """The true change of the wall between the reference epoch, before anything fell, and one later epoch of a simulation.

    Attributes
    ----------
    number : Number of the epoch, from 1.
    records : One dictionary for each fallen block (label, volume, ...), as in blocks.json.
    block : (h, w) labels of the blocks, 0 outside.
    change : (h, w) change along z of the wall frame, reference minus epoch, m; 0 where nothing fell.
    stable : (h, w) true on stable ground, more than 10 cm from any block.
    """

    number: int
    records: list[dict[str, Any]]
    block: IntArray
    change: Raster
    stable: NDArray[np.bool_]


@dataclass(frozen=True)
class SensorObservations:
    """What one sensor of a comparison observed in the reference epoch and in e epochs with rockfall.

    Attributes
    ----------
    setup : The sensor and its config.
    site : The wall with the sensor in front of it.
    changes : (e, h, w) difference maps, reference minus epoch, m; NaN without data.
    points : Number of points of the reference and of each epoch.
    seconds : Computing time of each epoch, from measurement to difference map, s.
    registration_rms_m : RMS distance of ICP's inliers in each epoch, m; empty without ICP.
    reference : The observation of the reference epoch.
    range_m, incidence_rad, visible : (h, w) range, m, and incidence angle, rad, at each pixel of the wall before any rockfall,
        and whether the sensor sees it.
    """

    setup: SensorSetup
    site: SensorSite
    changes: Raster
    points: tuple[int, ...]
    seconds: tuple[float, ...]
    registration_rms_m: tuple[float, ...]
    reference: Acquisition
    range_m: Raster
    incidence_rad: Raster
    visible: NDArray[np.bool_]


@dataclass(frozen=True)
class Trial:
    """The simulation on which a comparison of sensors is based.

    Attributes
    ----------
    grid : Raster that all difference maps share.
    wall : The wall before any rockfall, at every pixel of the raster.
    epochs : The true change of the wall in each epoch with rockfall.
    seen : What each sensor observed.
    """

    grid: Grid
    wall: UntouchedWall
    epochs: list[TrueEpoch]
    seen: list[SensorObservations]


def compare(
    sensors: Sequence[SensorSetup], epochs: int, sizes_m: tuple[float, float] | None, progress: Progress | None = None
) -> Trial:
    """Simulate what several sensors observe of one wall, before rockfall and in each epoch with rockfall.

    Parameters
    ----------
    sensors : The sensors; the first one's config gives wall, blocks and random numbers.
    epochs : Number of epochs with rockfall.
    sizes_m : Block sizes in the first and the last epoch, m. They grow geometrically in between, so that the smallest
        detectable size lies within them. None: the blocks of the config.
    progress : Display of the progress; None: nothing is shown.

    Returns
    -------
    The true changes, and what each sensor observed.

    Raises
    ------
    InputError
        If the sensors do not face the same side of the wall, or wall, sensors or blocks cannot be simulated.
    """
    progress = progress or Progress()
    numbers = range(1, epochs + 1)
    weights = {f"{each.name}: epoch {number}": 4.0 for number in (0, *numbers) for each in sensors}
    progress.plan({"wall": 3.0} | {f"epoch {number}: carve": 3.0 for number in numbers} | weights)
    config, random = sensors[0].config, KeyedRandom(sensors[0].config.seed)
    with progress.stage("wall"):
        sites = [prepare_site(each.config, each.sensor, random) for each in sensors]
        _check_one_frame(sensors, sites)
        caster = RayCaster(with_wetness(config, sites[0].mesh))
        grid = raster_grid(sites[0].mesh.bounds, config.difference)
        untouched, wall = cast_raster(caster, grid), untouched_wall(caster, grid)
    runs = []
    for each, site in zip(sensors, sites, strict=True):
        with progress.stage(f"{each.name}: epoch 0"):
            runs.append(_SensorRun(each, site, caster, grid, random))
    truths = []
    for number, rockfall in zip(numbers, rockfalls(config.rockfall, sites[0].mesh.bounds, epochs, sizes_m), strict=True):
        keyed = random.child("epoch", number)
        with progress.stage(f"epoch {number}: carve"):
            blocks = place_blocks(rockfall, sites[0].mesh, keyed.child("blocks"), caster)
            carved = carve(sites[0].mesh, blocks)
            after = RayCaster(with_wetness(config, carved.mesh))
            truths.append(
                _true_epoch(number, block_records(blocks, carved.removed_volume_m3), untouched, cast_raster(after, grid))
            )
        for run in runs:
            with progress.stage(f"{run.setup.name}: epoch {number}"):
                run.observe(after, keyed)
    return Trial(grid, wall, truths, [run.seen(wall, caster) for run in runs])


def rockfalls(
    config: RockfallConfig, bounds: FloatArray, epochs: int, sizes_m: tuple[float, float] | None
) -> list[RockfallConfig]:
    """Set sizes and number of the blocks that fall in each epoch of a comparison; sizes grow from epoch to epoch.

    Parameters
    ----------
    config : The rockfall section of the config, which gives all other settings.
    bounds : (2, 3) lowest and highest corner of the wall's bounding box, wall frame, m.
    epochs : Number of epochs.
    sizes_m : Mean block sizes of the first and the last epoch, m; None: the config's blocks in each epoch.

    Returns
    -------
    Rockfall settings of each epoch. The number of blocks is the config's, or fewer if the wall has no room for them.
    """
    if sizes_m is None:
        return [config] * epochs
    area = float(np.prod((bounds[1] - bounds[0])[:2]))
    result = []
    for side in np.geomspace(*sizes_m, epochs):
        room = int(_CROWDING * area / (1.5 * side + config.minimum_distance_m) ** 2)
        size = Gaussian(mean=float(side), sigma=_SIZE_SPREAD * float(side), minimum=_SMALLEST_SHARE * float(side))
        result.append(config.model_copy(update={"size_m": size, "count": max(min(config.count, room), 1)}))
    return result


def _check_one_frame(sensors: Sequence[SensorSetup], sites: Sequence[SensorSite]) -> None:
    """Raise InputError if a sensor faces another side of the wall than the first one."""
    for each, site in zip(sensors, sites, strict=True):
        if not np.allclose(site.frame.matrix, sites[0].frame.matrix, atol=1e-9):
            raise InputError(
                f"the sensor faces another side of the wall than {sensors[0].name}",
                where=each.name,
                remedy="compare sensors that face the same side",
            )


def _true_epoch(number: int, records: list[dict[str, Any]], before: SurfaceRaster, after: SurfaceRaster) -> TrueEpoch:
    """Compute the true change and the stable ground from the wall before and after the rockfall."""
    change = difference(before, after)
    change = np.where(np.abs(change) < _LEAST_CHANGE_M, 0.0, change).astype(np.float32)
    touched = (after.block != WALL) | (change != 0)  # holes of the wall (NaN) are not stable either
    reach = round(_MARGIN_M / before.grid.gsd)
    distance = ndimage.distance_transform_edt(~touched) if touched.any() else np.full(touched.shape, np.inf)
    return TrueEpoch(number, records, after.block, change, distance > reach)


class _SensorRun:
    """Observes the epochs of one sensor."""

    def __init__(self, setup: SensorSetup, site: SensorSite, caster: RayCaster, grid: Grid, random: KeyedRandom) -> None:
        self.setup, self.site, self.config = setup, site, setup.config
        for where, viewpoint in site.viewpoints.items():
            check_in_front(caster, viewpoint, f"{setup.name}: {where}")
        self.first = acquire(self.config, reference_sensor(self.config, site), caster, random.child("epoch", 0, "observe"))
        keyed = random.child("epoch", 0, "register")
        surface, self.target = reference_and_target(self.config, reconstruct(self.config, self.first), caster.mesh, keyed)
        self.raster = surface_raster(surface, grid)
        self.changes: list[Raster] = []
        self.points = [_count(self.first)]
        self.seconds: list[float] = []
        self.rms_m: list[float] = []

    def observe(self, after: RayCaster, keyed: KeyedRandom) -> None:
        """Observe, reconstruct, register and subtract one epoch, as `pipeline.run.epoch` does."""
        began = time.perf_counter()
        seen = acquire(self.config, self.site, after, keyed.child("observe"))
        surface = reconstruct(self.config, seen)
        if self.config.icp is not None and self.target is not None:
            found = register_to(self.target, surface.vertices, self.config.icp, keyed.child("register"))
            surface = surface.with_vertices(found.apply(surface.vertices))
            self.rms_m.append(found.rms_m)
        self.changes.append(difference(self.raster, surface_raster(surface, self.raster.grid)))
        self.points.append(_count(seen))
        self.seconds.append(time.perf_counter() - began)

    def seen(self, wall: UntouchedWall, caster: RayCaster) -> SensorObservations:
        """Return everything observed so far, with the covariates of the untouched wall."""
        viewpoints = list(self.site.viewpoints.values())
        distance, incidence = range_and_incidence(wall, viewpoints)
        return SensorObservations(
            self.setup,
            self.site,
            np.stack(self.changes),
            tuple(self.points),
            tuple(self.seconds),
            tuple(self.rms_m),
            self.first,
            distance,
            incidence,
            visible(wall, caster, viewpoints, every=self.setup.sensor == "stereo"),
        )


def _count(seen: Acquisition) -> int:
    """Count the points of an observation, further returns included."""
    return sum(int(each.valid.sum()) + (0 if each.further is None else len(each.further.cell)) for each in seen.observations)
