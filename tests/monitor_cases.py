"""A rough wall, points on it with noise, and blocks that fall from it, all known."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np

from scene.geometry.mesh import FloatArray

UTM = np.array([345_200.0, 5_389_450.0, 120.0])
WIDTH_M, HEIGHT_M = 16.0, 10.0
NOISE_M = 0.003
STATION = "345208 5389400 124"


def depth(x: FloatArray, z: FloatArray) -> FloatArray:
    """How far the wall stands out towards the sensor at -y, m."""
    return 0.5 * np.sin(0.9 * x) * np.cos(1.1 * z) + 0.15 * np.sin(3.1 * x + 2.0 * z) + 0.04 * np.sin(9.0 * z - 4.0 * x)


def points(
    count: int, seed: int, blocks: tuple[tuple[float, float, float, float], ...] = (), noise_m: float = NOISE_M
) -> FloatArray:
    """(n, 3) points in projected coordinates, m; blocks: x, z, side and depth of cuboids that are missing."""
    random = np.random.default_rng(seed)
    x, z = random.uniform([0, 0], [WIDTH_M, HEIGHT_M], (count, 2)).T
    out = depth(x, z)
    for at_x, at_z, side, deep in blocks:
        out = np.where((np.abs(x - at_x) < side / 2) & (np.abs(z - at_z) < side / 2), out - deep, out)
    return np.column_stack([x, -out + noise_m * random.normal(size=count), z]) + UTM


def las(path: Path, coordinates: FloatArray, crs: int | None = 32632, scale_m: float = 1e-4) -> Path:
    """A LAS file of points."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, scale_m), np.floor(coordinates.min(axis=0))
    if crs is not None:
        import pyproj

        header.add_crs(pyproj.CRS.from_epsg(crs))
    data = laspy.LasData(header)
    data.x, data.y, data.z = coordinates.T
    data.write(str(path))
    return path
