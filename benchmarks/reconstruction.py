"""Compare direct triangulation with COLMAP's fusion and Poisson surface, each against the true wall (low quality)."""

from __future__ import annotations

import numpy as np
from measure import peak_memory_gb, seconds

from pipeline.change.difference import DifferenceConfig, cast_raster, difference, raster_grid, statistics, surface_raster
from pipeline.surface.depth_maps import DepthMap
from pipeline.surface.mesh import SurfaceConfig, mesh_observation
from pipeline.surface.reconstruct import FusionConfig, colmap_surface
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import TriangleMesh
from scene.ray_casting.raycast import RayCaster
from scene.walls.procedural import ProceduralWall
from sensors.models.placement import RigConfig, Target
from sensors.models.sensor_model import StereoModel, StereoNoise
from sensors.stereo.exchanged import depth_cameras, observe_right
from sensors.stereo.stereo_pair import StereoPair

GSD_M = 0.05
NOISE = {
    "none": StereoNoise(parallax_sigma_px=0.0, regularization_sigma_px=0.0),
    "matching": StereoNoise(parallax_sigma_px=0.6, regularization_sigma_px=0.25),
}


def main() -> None:
    random, surface, fusion = KeyedRandom(1), SurfaceConfig(), FusionConfig()
    world = ProceduralWall(style="glendale", resolution_m=0.0697).mesh(random)
    cameras = RigConfig(k1=-0.05).place(Target(world))
    frame = WallFrame.fit(world.vertices, cameras.left.position)
    caster = RayCaster(world.with_vertices(frame.to_wall(world.vertices)))
    grid = raster_grid(caster.mesh.bounds, DifferenceConfig(gsd_m=GSD_M))
    truth = cast_raster(caster, grid)
    print(f"glendale, {len(world.faces):,} triangles, depth maps at low quality; surface minus truth along z, GSD {GSD_M} m")
    print("mean, StD, RMS, NMAD: of the pixels that both surfaces cover; RMS of all: of those that each one covers")
    print("| noise | reconstruction | mean mm | StD mm | RMS mm | NMAD mm | RMS of all mm | covered | vertices | s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, noise in NOISE.items():
        pair = StereoPair(cameras, frame, StereoModel(noise=noise), "low")
        left, right = pair.observe(caster, random), observe_right(pair, caster, random)
        valid = left.valid
        maps = [DepthMap(camera, seen.depth) for camera, seen in zip(depth_cameras(pair), (left, right), strict=True)]
        made: dict[str, TriangleMesh] = {}

        def direct(seen=left, made=made) -> None:
            made["direct"] = mesh_observation(seen, surface)

        def colmap(maps=maps, points=left.points[valid], block=left.block[valid], made=made) -> None:
            made["colmap"] = colmap_surface(*maps, points, block, surface, fusion)

        took = {kind: seconds(work) for kind, work in (("direct", direct), ("colmap", colmap))}
        error = {kind: -difference(truth, surface_raster(mesh, grid)) for kind, mesh in made.items()}
        shared = ~np.isnan(error["direct"]) & ~np.isnan(error["colmap"])
        for kind, values in error.items():
            found, everywhere = statistics(values[shared]), statistics(values)
            lengths = (found.mean, found.standard_deviation, found.rmse, found.nmad, everywhere.rmse)
            figures = " | ".join(f"{1e3 * value:.1f}" for value in lengths)
            share = everywhere.count / values.size
            print(f"| {name} | {kind} | {figures} | {share:.3f} | {len(made[kind].vertices):,} | {took[kind]:.1f} |")
    print(f"peak memory {peak_memory_gb():.2f} GB")


if __name__ == "__main__":
    main()
