"""The raster of a surface (heights and labels, 3500 x 1500 pixels) against the bare cast of the same rays; target: at most 2."""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable

import numpy as np

from pipeline.annotate import AnnotationConfig, LabelledImage, coco
from pipeline.difference import cast_raster, surface_raster
from pipeline.mesh import SurfaceConfig, mesh_observation
from scene.backend import VARIANT, dr, mi
from scene.grid import Grid
from scene.mesh import TriangleMesh
from scene.raycast import RayCaster
from sensors.observation import Observation

ROUNDS = 7
PIXELS = (3500, 1500)
SAMPLES = (900, 1500)


def wall() -> tuple[TriangleMesh, float]:
    """A rough wall of 70 x 30 m meshed from 1.35 M samples with 1,500 labelled patches, and the seconds that meshing took."""
    x, y = np.meshgrid(np.linspace(0, 70, SAMPLES[1]), np.linspace(30, 0, SAMPLES[0]))
    z = 0.5 * np.sin(x) * np.cos(0.7 * y) + np.random.default_rng(1).normal(0, 0.02, x.shape)
    viewpoint = np.array([35.0, 15.0, 105.0])
    points = np.stack([x, y, z], axis=-1)
    block = ((np.arange(SAMPLES[0])[:, None] // 30) * 50 + np.arange(SAMPLES[1]) // 30).astype(np.int32)
    observation = Observation("stereo", points, 105.0 - z, block, viewpoint)
    start = time.perf_counter()
    return mesh_observation(observation, SurfaceConfig()), time.perf_counter() - start


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def main() -> None:
    mesh, meshing = wall()
    grid = Grid(0.0, 30.0, 0.02, *PIXELS)
    caster = RayCaster(mesh)
    column, row = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    x, y = grid.x_min + (column.ravel() + 0.5) * grid.gsd, grid.y_max - (row.ravel() + 0.5) * grid.gsd
    origin = mi.Point3f(mi.Float(x), mi.Float(y), dr.full(mi.Float, mesh.bounds[1, 2] + 1.0, x.size))
    dr.eval(origin)

    def bare() -> None:
        dr.eval(caster._scene.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)), coherent=True))
        dr.sync_thread()

    bare()  # compiles the kernels and fills the caster's tables
    raster = cast_raster(caster, grid)
    rounds = [(seconds(bare), seconds(lambda: cast_raster(caster, grid))) for _ in range(ROUNDS)]
    cast, cast_and_refined = (statistics.median(column) for column in zip(*rounds, strict=True))
    whole = seconds(lambda: surface_raster(mesh, grid))
    annotating = seconds(lambda: coco([LabelledImage("difference_001.tif", raster.block, grid, 1)], AnnotationConfig()))

    print(f"{VARIANT}, {len(mesh.faces):,} triangles, raster {PIXELS[0]} x {PIXELS[1]}, median of {ROUNDS}")
    print(f"bare cast of the pixels           {cast:7.3f} s")
    print(
        f"raster: heights and labels        {cast_and_refined:7.3f} s   ratio {cast_and_refined / cast:.2f} (target: at most 2)"
    )
    print(f"raster, preparing the mesh too    {whole:7.3f} s")
    print(f"grid triangulation, {SAMPLES[0] * SAMPLES[1] / 1e6:.2f} M points {meshing:6.3f} s")
    print(f"COCO of 1,500 blocks              {annotating:7.3f} s")
    print(f"peak memory                       {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:7.2f} GB")


if __name__ == "__main__":
    main()
