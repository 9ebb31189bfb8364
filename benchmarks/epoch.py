"""Measure the time of one whole Glendale epoch against the sum of its bare casts and booleans.

The epoch has 1,500 blocks and all products.

    python benchmarks/epoch.py [stereo|tls]     (GSD 2 cm; target: at most 5 times the sum, about 30 s, 4 GB)

The sum has the casts of the observation and of the difference raster's pixels, each alone on rays in memory, and one Manifold
boolean of the closed wall and all blocks with finished solids. The wall and the reference epoch are made before.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from carve import time_bare
from measure import bare_cast, bare_test, medians, peak_memory_gb

from pipeline.config.bundled import bundled_config
from pipeline.config.simulation import SensorName, load_config
from pipeline.report.progress import Progress
from pipeline.run.epoch import observe_epoch, observe_reference
from pipeline.run.products import write_epoch, write_reference
from pipeline.run.site import SensorSite, prepare_site
from scene.blocks.block import place_blocks
from scene.common.backend import VARIANT, dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.ray_casting.raycast import RayCaster
from sensors.laser.tls import LaserScanner
from sensors.numerics.device import rotated, vector
from sensors.signal_chain.pulses import direction
from sensors.stereo.stereo_pair import SHADOW_MARGIN, StereoPair


def observation_casts(site: SensorSite, caster: RayCaster) -> float:
    """Seconds of the bare casts that the sensor needs."""
    if isinstance(site.sensor, LaserScanner):
        pulses = site.sensor.emit()
        aim = rotated(site.sensor.rotation, direction(pulses.aim_azimuth, pulses.aim_zenith))
        return medians(bare_cast(caster, vector(site.sensor.position), aim), rounds=3)[0]
    assert isinstance(site.sensor, StereoPair)
    cameras = site.sensor.cameras.in_wall_frame(site.frame)
    _, u, v = site.sensor.cells()
    x, y = cameras.left.on_device().tangents(u, v)
    origin, ahead = vector(cameras.left.position), rotated(cameras.left.rotation, mi.Array3f64(x, y, 1.0))
    point = origin + caster.intersect(origin, ahead).distance * ahead
    centre = vector(cameras.right.position)
    return sum(medians(bare_cast(caster, origin, ahead), bare_test(caster, centre, point - centre, 1 - SHADOW_MARGIN), rounds=3))


def raster_cast(caster: RayCaster, grid: Grid) -> float:
    """Seconds of the bare cast of a raster's pixels."""
    index = dr.arange(mi.UInt32, grid.width * grid.height)
    row, column = mi.Float64(index // grid.width), mi.Float64(index % grid.width)
    top = float(caster.mesh.bounds[1, 2]) + 1
    origin = mi.Array3f64(grid.x_min + (column + 0.5) * grid.gsd, grid.y_max - (row + 0.5) * grid.gsd, top)
    return medians(bare_cast(caster, origin, mi.Array3f64(0, 0, -1)), rounds=3)[0]


def main(sensor: SensorName) -> None:
    config = load_config(bundled_config("sites", "glendale"), [], sensor, None)
    random, progress = KeyedRandom(config.seed), Progress()
    site = prepare_site(config, sensor, random)
    reference = observe_reference(config, site, random, progress)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        write_reference(out, config, site, reference, reference.seen)
        reference = replace(reference, seen=None)
        progress.timings.clear()
        start = time.perf_counter()
        epoch = observe_epoch(config, site, reference, 1, random, progress)
        with progress.stage("epoch 1: write"):
            write_epoch(out, config, site, reference, epoch)
        whole = time.perf_counter() - start
        memory = peak_memory_gb()
        size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    casts = observation_casts(site, reference.caster) + raster_cast(RayCaster(epoch.surface), reference.raster.grid)
    blocks = place_blocks(config.rockfall, site.mesh, random.child("epoch", 1).child("blocks"), reference.caster)
    boolean = time_bare(site.mesh, blocks)["seconds"]
    grid = reference.raster.grid
    print(f"{VARIANT}, {sensor}: {len(site.mesh.faces):,} triangles, {len(blocks)} blocks,")
    print(f"{epoch.seen.observation.depth.size:,} rays, raster {grid.width} x {grid.height}, {size:.0f} MB with the reference's,")
    print(f"volumes balance to {np.abs(epoch.carved.balance_m3) / epoch.carved.wall_volume_m3:.0e} of the wall's")
    for name, seconds in progress.timings.items():
        print(f"  {name:24}{seconds:6.2f} s")
    print(f"one epoch                 {whole:6.2f} s   (target: about 30 s)")
    print(f"bare casts and boolean    {casts:6.2f} + {boolean:.2f} s")
    print(f"ratio                     {whole / (casts + boolean):6.2f}     (target: at most 5)")
    print(f"peak memory of the epoch  {memory:6.2f} GB  (target: 4 GB)")


if __name__ == "__main__":
    main("tls" if sys.argv[1:] == ["tls"] else "stereo")
