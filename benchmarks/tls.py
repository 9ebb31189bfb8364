"""Measure one TLS observation of 5 M pulses on 1.3 M triangles against casting the same rays, and against Open3D's cast_rays.

    python benchmarks/tls.py [--avx2]           (as on a processor without AVX-512)

Target: at least 0.5 of the bare rate, and at least Open3D's. Open3D casts on the processor, so it is left out on a graphics card.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np
from measure import bare_cast, empty_kernel_cache, medians, narrow_vectors, peak_memory_gb, seconds

from scene.common.backend import CUDA, VARIANT, dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.laser.tls import LaserScanner, ScannerConfig
from sensors.models.placement import StationConfig, Target
from sensors.models.sensor_model import TlsModel
from sensors.numerics.device import rotated, vector
from sensors.signal_chain.pulses import direction

PULSES = 5_000_000


def prepared(pulses: int) -> tuple[LaserScanner, RayCaster, KeyedRandom]:
    """Return a scanner of about so many pulses in front of a wall, the wall's ray caster, and the source of random numbers."""
    random = KeyedRandom(1)
    world = ProceduralWall(style="glendale", resolution_m=0.0697).mesh(random)
    station = StationConfig().place(Target(world))
    frame = WallFrame.fit(world.vertices, station[0])
    mesh = world.with_vertices(frame.to_wall(world.vertices))
    coarse = LaserScanner.aimed(station, frame, mesh.vertices, ScannerConfig(), TlsModel())
    step = ScannerConfig().azimuth_step_rad * np.sqrt(coarse.pattern.lines * coarse.pattern.pulses / pulses)
    scanner = LaserScanner.aimed(
        station, frame, mesh.vertices, ScannerConfig(azimuth_step_rad=step, zenith_step_rad=step), TlsModel()
    )
    return scanner, RayCaster(mesh), random


def open3d_cast(mesh: TriangleMesh, origin: np.ndarray, aim: mi.Vector3f) -> Callable[[], object]:
    """Return what casts the same rays with Open3D, from `origin` (3,), m, along the unit vectors `aim`, 3 x (n,)."""
    import open3d as o3d

    peer = o3d.t.geometry.RaycastingScene()
    peer.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    directions = np.array(mi.Vector3f(aim), dtype=np.float32).T
    rays = o3d.core.Tensor(np.hstack([np.broadcast_to(np.float32(origin), directions.shape), directions]))
    return lambda: peer.cast_rays(rays)


def cold() -> None:
    """Time the first observation of a process that finds no compiled kernel, and the second."""
    narrow_vectors()
    scanner, caster, random = prepared(PULSES)
    first, second = (seconds(lambda: scanner.observe(caster, random)) for _ in range(2))
    print(f"first observation, empty kernel cache {first:6.3f} s   (the second {second:.3f} s)", flush=True)


def main() -> None:
    with empty_kernel_cache() as environment:
        subprocess.run([sys.executable, __file__, "--cold", *sys.argv[1:]], check=True, env=environment)
    lanes = ", 8 lanes" if narrow_vectors() else ""
    scanner, caster, random = prepared(PULSES)
    mesh, count = caster.mesh, scanner.pattern.lines * scanner.pattern.pulses

    pulses = scanner.emit()
    aim = rotated(scanner.rotation, direction(pulses.aim_azimuth, pulses.aim_zenith))
    origin = vector(scanner.position)
    bare = bare_cast(caster, origin, aim)

    works = [lambda: scanner.observe(caster, random), bare]
    ours, cast, *peer = medians(*works, *([] if VARIANT == CUDA else [open3d_cast(mesh, scanner.position, aim)]))
    print(f"{VARIANT}{lanes}, {dr.thread_count()} threads, {len(mesh.faces):,} triangles, {count:,} pulses")
    print(f"bare ray_intersect_preliminary        {cast:6.3f} s   {count / cast / 1e6:5.1f} M/s")
    for open3d in peer:
        print(f"Open3D cast_rays                      {open3d:6.3f} s   {count / open3d / 1e6:5.1f} M/s")
    print(f"observation: noise, float64, points   {ours:6.3f} s   {count / ours / 1e6:5.1f} M/s")
    print(f"share of the bare rate                {cast / ours:6.2f}     (target: at least 0.5)")
    for open3d in peer:
        print(f"rate over Open3D's                    {open3d / ours:6.2f}     (target: at least 1)")
    print(f"peak memory                           {peak_memory_gb():6.2f} GB")


if __name__ == "__main__":
    cold() if "--cold" in sys.argv else main()
