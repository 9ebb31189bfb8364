"""Measure the time of rasterising a surface against casting the same rays; target: at most 2 times.

The raster of heights and labels has 3500 x 1500 pixels.
"""

from __future__ import annotations

import numpy as np
from measure import bare_cast, medians, peak_memory_gb, seconds

from pipeline.change.annotate import AnnotationConfig, LabelledImage, coco
from pipeline.change.difference import cast_raster, surface_raster
from pipeline.surface.mesh import SurfaceConfig, mesh_observation
from scene.common.backend import VARIANT, mi
from scene.geometry.grid import Grid
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device
from sensors.signal_chain.observation import Observation

PIXELS = (3500, 1500)
SAMPLES = (900, 1500)


def observed() -> Observation:
    """1.35 M samples of a rough wall of 70 x 30 m with 1,500 labelled patches."""
    x, y = np.meshgrid(np.linspace(0, 70, SAMPLES[1]), np.linspace(30, 0, SAMPLES[0]))
    z = 0.5 * np.sin(x) * np.cos(0.7 * y) + np.random.default_rng(1).normal(0, 0.02, x.shape)
    viewpoint = np.array([35.0, 15.0, 105.0])
    points = np.stack([x, y, z], axis=-1)
    block = ((np.arange(SAMPLES[0])[:, None] // 30) * 50 + np.arange(SAMPLES[1]) // 30).astype(np.int32)
    return Observation("stereo", points, 105.0 - z, block, viewpoint)


def main() -> None:
    seen = observed()
    mesh = mesh_observation(seen, SurfaceConfig())
    grid = Grid(0.0, 30.0, 0.02, *PIXELS)
    caster = RayCaster(mesh)
    column, row = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    x, y = grid.x_min + (column.ravel() + 0.5) * grid.gsd, grid.y_max - (row.ravel() + 0.5) * grid.gsd
    above = (on_device(mi.Float64, values) for values in (x, y, np.full(x.size, mesh.bounds[1, 2] + 1.0)))
    bare = bare_cast(caster, mi.Array3f64(*above), mi.Array3f64(0.0, 0.0, -1.0))
    cast, cast_and_refined = medians(bare, lambda: cast_raster(caster, grid))
    raster = cast_raster(caster, grid)
    meshing, whole = seconds(lambda: mesh_observation(seen, SurfaceConfig())), seconds(lambda: surface_raster(mesh, grid))
    annotating = seconds(lambda: coco([LabelledImage("difference_001.tif", raster.block, grid, 1)], AnnotationConfig()))

    print(f"{VARIANT}, {len(mesh.faces):,} triangles, raster {PIXELS[0]} x {PIXELS[1]}, medians")
    print(f"bare cast of the pixels           {cast:7.3f} s")
    print(
        f"raster: heights and labels        {cast_and_refined:7.3f} s   ratio {cast_and_refined / cast:.2f} (target: at most 2)"
    )
    print(f"raster, preparing the mesh too    {whole:7.3f} s")
    print(f"grid triangulation, {SAMPLES[0] * SAMPLES[1] / 1e6:.2f} M points {meshing:6.3f} s")
    print(f"COCO of 1,500 blocks              {annotating:7.3f} s")
    print(f"peak memory                       {peak_memory_gb():7.2f} GB")


if __name__ == "__main__":
    main()
