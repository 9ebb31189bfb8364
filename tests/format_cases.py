"""A cloud, a mesh and a raster with every kind of content that files can hold, for the tests of the formats."""

from __future__ import annotations

import numpy as np

from pipeline.formats.point_cloud import PointCloud
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh

UTM = np.array([331_245.0, 6_270_118.0, 412.0])
GRID = Grid(x_min=1.25, y_max=9.5, gsd=0.02, width=70, height=40)


def a_cloud() -> PointCloud:
    """Return more points than two chunks of LAZ hold, with every kind of channel."""
    rng = np.random.default_rng(1)
    count = 120_000
    return PointCloud(
        points=rng.uniform([0, 0, -3], [70, 45, 3], (count, 3)),
        intensity=rng.lognormal(0, 2, count).astype(np.float32),
        gps_time=np.arange(count) * 1e-5 + 0.1,
        extra={
            "true_range_m": rng.uniform(90, 110, count),
            "cos_incidence": rng.uniform(0, 1, count).astype(np.float32),
            "block": rng.integers(0, 1500, count).astype(np.int32),
        },
    )


def a_mesh() -> TriangleMesh:
    """Return a bumpy sheet of 50 x 30 vertices in UTM-sized coordinates, with every attribute of a mesh."""
    rng = np.random.default_rng(2)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(50.0), np.arange(30.0)))
    first = (np.arange(29)[:, None] * 50 + np.arange(49)).ravel()
    lower, upper = np.stack([first, first + 1, first + 50], axis=1), np.stack([first + 1, first + 51, first + 50], axis=1)
    return TriangleMesh(
        vertices=UTM + np.stack([x, y, rng.normal(size=x.size)], axis=1),
        faces=np.concatenate([lower, upper]).astype(np.int32),
        vertex_albedo=rng.uniform(0, 1, x.size).astype(np.float32),
        vertex_block=rng.integers(0, 9, x.size).astype(np.int32),
        face_block=rng.integers(0, 9, 2 * first.size).astype(np.int32),
    )


def a_raster() -> np.ndarray:
    """Return a raster over GRID with a hole."""
    raster = np.random.default_rng(3).normal(0, 0.01, GRID.shape).astype(np.float32)
    raster[:5, 10:20] = np.nan
    return raster
