"""Several sensors in front of one wall, from which the same blocks fall: what their difference maps are good for.

Wall, blocks, pixels and seed are the same for all; each sensor has its own place, noise, reconstruction and registration. What
changed is known, so noise is measured where nothing fell (stable ground, 10 cm from any block) and errors everywhere.
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
from pipeline.comparison.covariates import Ground, ground, range_and_incidence, visible
from pipeline.comparison.sensors_compared import Contestant
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
"""From blocks to stable ground: more than a reconstruction blurs."""
_LEAST_CHANGE_M = 1e-4
"""Smaller changes of the true wall are the ray caster's rounding."""
_CROWDING = 0.15
"""Share of the wall that the blocks of an epoch may take with the room around them."""
_SIZE_SPREAD, _SMALLEST_SHARE = 0.15, 0.5


@dataclass(frozen=True)
class TrueEpoch:
    """What really happened before an epoch. block: (h, w) labels; change: (h, w), m, 0 where nothing fell; stable: (h, w)."""

    number: int
    records: list[dict[str, Any]]
    block: IntArray
    change: Raster
    stable: NDArray[np.bool_]


@dataclass(frozen=True)
class Seen:
    """What one sensor saw. site: with its viewpoints; changes: (e, h, w) difference maps, m; points: of the reference and of each
    epoch; seconds: to simulate each epoch without carving; registration_rms_m: of each epoch, none without ICP; reference: the
    first look; range_m, incidence_rad, visible: (h, w) of the untouched wall."""

    contestant: Contestant
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
    """All that was simulated: the wall at every pixel of the shared grid, the epochs as they were and as each sensor saw them."""

    grid: Grid
    ground: Ground
    epochs: list[TrueEpoch]
    seen: list[Seen]


def compare(
    sensors: Sequence[Contestant], epochs: int, sizes_m: tuple[float, float] | None, progress: Progress | None = None
) -> Trial:
    """Observe the wall of the first sensor's config before and after rocks fall, `epochs` times, with every sensor.

    sizes_m: blocks of epoch k have sides about s_k, which grow geometrically from the first to the second, so that the smallest
    visible block is bracketed; None: the blocks of the config. Raises InputError where the sensors do not face the same side of
    the wall, and for whatever is wrong with wall, sensors and blocks.
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
        untouched, on = cast_raster(caster, grid), ground(caster, grid)
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
            with progress.stage(f"{run.contestant.name}: epoch {number}"):
                run.observe(after, keyed)
    return Trial(grid, on, truths, [run.seen(on, caster) for run in runs])


def rockfalls(
    config: RockfallConfig, bounds: FloatArray, epochs: int, sizes_m: tuple[float, float] | None
) -> list[RockfallConfig]:
    """The blocks of each epoch: the config's, or with sides that grow from epoch to epoch, as many of them as have room."""
    if sizes_m is None:
        return [config] * epochs
    area = float(np.prod((bounds[1] - bounds[0])[:2]))
    result = []
    for side in np.geomspace(*sizes_m, epochs):
        room = int(_CROWDING * area / (1.5 * side + config.minimum_distance_m) ** 2)
        size = Gaussian(mean=float(side), sigma=_SIZE_SPREAD * float(side), minimum=_SMALLEST_SHARE * float(side))
        result.append(config.model_copy(update={"size_m": size, "count": max(min(config.count, room), 1)}))
    return result


def _check_one_frame(sensors: Sequence[Contestant], sites: Sequence[SensorSite]) -> None:
    for each, site in zip(sensors, sites, strict=True):
        if not np.allclose(site.frame.matrix, sites[0].frame.matrix, atol=1e-9):
            raise InputError(
                f"does not face the side of the wall that {sensors[0].name} faces",
                where=each.name,
                remedy="compare sensors that look at the same face",
            )


def _true_epoch(number: int, records: list[dict[str, Any]], before: SurfaceRaster, after: SurfaceRaster) -> TrueEpoch:
    change = difference(before, after)
    change = np.where(np.abs(change) < _LEAST_CHANGE_M, 0.0, change).astype(np.float32)
    touched = (after.block != WALL) | (change != 0)  # NaN is not 0: holes of the wall are not stable either
    reach = round(_MARGIN_M / before.grid.gsd)
    distance = ndimage.distance_transform_edt(~touched) if touched.any() else np.full(touched.shape, np.inf)
    return TrueEpoch(number, records, after.block, change, distance > reach)


class _SensorRun:
    """One sensor's observations, epoch by epoch."""

    def __init__(self, contestant: Contestant, site: SensorSite, caster: RayCaster, grid: Grid, random: KeyedRandom) -> None:
        self.contestant, self.site, self.config = contestant, site, contestant.config
        for where, viewpoint in site.viewpoints.items():
            check_in_front(caster, viewpoint, f"{contestant.name}: {where}")
        self.first = acquire(self.config, reference_sensor(self.config, site), caster, random.child("epoch", 0, "observe"))
        keyed = random.child("epoch", 0, "register")
        surface, self.target = reference_and_target(self.config, reconstruct(self.config, self.first), caster.mesh, keyed)
        self.raster = surface_raster(surface, grid)
        self.changes: list[Raster] = []
        self.points = [_count(self.first)]
        self.seconds: list[float] = []
        self.rms_m: list[float] = []

    def observe(self, after: RayCaster, keyed: KeyedRandom) -> None:
        """Observe, reconstruct, register and difference, as `pipeline.run.epoch` does."""
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

    def seen(self, on: Ground, caster: RayCaster) -> Seen:
        """What has been observed, with what it may depend on."""
        viewpoints = list(self.site.viewpoints.values())
        distance, incidence = range_and_incidence(on, viewpoints)
        return Seen(
            self.contestant,
            self.site,
            np.stack(self.changes),
            tuple(self.points),
            tuple(self.seconds),
            tuple(self.rms_m),
            self.first,
            distance,
            incidence,
            visible(on, caster, viewpoints, every=self.contestant.sensor == "stereo"),
        )


def _count(seen: Acquisition) -> int:
    return sum(int(each.valid.sum()) + (0 if each.further is None else len(each.further.cell)) for each in seen.observations)
