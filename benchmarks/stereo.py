"""Measure one stereo observation against the bare ray casts it needs; target: at most 3 times.

It has medium quality and 1.3 M triangles.
"""

from __future__ import annotations

from measure import bare_cast, bare_test, medians, peak_memory_gb

from scene.common.backend import VARIANT, dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel
from sensors.numerics.device import rotated, vector
from sensors.stereo.stereo_pair import SHADOW_MARGIN, StereoPair

NOISE = {
    "parallax_sigma_px": 0.6,
    "regularization_sigma_px": 0.25,
    "orientation": {"omega_rad": 1.7e-4, "phi_rad": 5e-5, "f_px": 2.5, "cx_px": 4.5, "k1": 0.005, "p1": 0.0005},
}


def main() -> None:
    random = KeyedRandom(1)
    world = ProceduralWall(style="glendale", resolution_m=0.0697).mesh(random)
    cameras = RigConfig().place(Target(world))
    frame = WallFrame.fit(world.vertices, cameras.left.position)
    mesh = world.with_vertices(frame.to_wall(world.vertices))
    caster = RayCaster(mesh)
    pair = StereoPair(cameras, frame, StereoModel(noise=NOISE))

    wall_pair = cameras.in_wall_frame(frame)
    _, u, v = pair.cells()
    x, y = wall_pair.left.on_device().tangents(u, v)
    origin, ahead = vector(wall_pair.left.position), rotated(wall_pair.left.rotation, mi.Array3f64(x, y, 1.0))
    point = origin + caster.intersect(origin, ahead).distance * ahead
    centre = vector(wall_pair.right.position)
    left = bare_cast(caster, origin, ahead)
    right = bare_test(caster, centre, point - centre, 1.0 - SHADOW_MARGIN)

    ours, first, second = medians(lambda: pair.observe(caster, random), left, right)
    rows, columns = pair.shape
    print(f"{VARIANT}, {dr.thread_count()} threads, {len(mesh.faces):,} triangles, depth map {columns} x {rows}")
    print(f"bare casts: left view, right view   {first:6.3f} + {second:.3f} s")
    print(f"observation: real cameras, matching noise, points {ours:6.3f} s")
    print(f"ratio                               {ours / (first + second):6.2f}   (target: at most 3)")
    print(f"peak memory                         {peak_memory_gb():6.2f} GB")


if __name__ == "__main__":
    main()
