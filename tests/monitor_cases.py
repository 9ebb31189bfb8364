"""A rough wall, points on it with noise, and blocks that fall from it, all known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np

from scene.geometry.mesh import FloatArray

UTM = np.array([345_200.0, 5_389_450.0, 120.0])
WIDTH_M, HEIGHT_M = 16.0, 10.0
NOISE_M, ANGLE_NOISE_RAD = 0.003, 4e-5
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


def scan(
    seed: int,
    ranges: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
    block: tuple[float, float, float, float] | None = None,
    step_rad: float = 0.0018,
    noise_m: float = NOISE_M,
) -> FloatArray:
    """(n, 3) points that a scanner at STATION measures on a grid of angles, line by line, projected coordinates, m.

    ranges: what is added to a range, from the range and the cosine of the incidence angle. block: as in `points`.
    """
    random = np.random.default_rng(seed)
    eye = np.array([float(each) for each in STATION.split()]) - UTM
    azimuth, zenith = np.meshgrid(np.arange(1.42, 1.722, step_rad), np.arange(1.46, 1.651, step_rad), indexing="ij")
    nominal = _rays(azimuth.ravel(), zenith.ravel())
    true = _rays(*(each.ravel() + ANGLE_NOISE_RAD * random.normal(size=each.size) for each in (azimuth, zenith)))
    distance = -eye[1] / true[:, 1]
    for _ in range(40):
        at = eye + distance[:, None] * true
        distance = (-depth(at[:, 0], at[:, 2]) - eye[1]) / true[:, 1]
    at = eye + distance[:, None] * true
    if block is not None:
        x, z, side, deep = block
        inside = (np.abs(at[:, 0] - x) < side / 2) & (np.abs(at[:, 2] - z) < side / 2)
        distance = np.where(inside, distance + deep / true[:, 1], distance)
    by_x, by_z = ((depth(at[:, 0] + dx, at[:, 2] + dz) - depth(at[:, 0], at[:, 2])) / 1e-6 for dx, dz in ((1e-6, 0), (0, 1e-6)))
    cosine = (true[:, 1] + true[:, 0] * by_x + true[:, 2] * by_z) / np.sqrt(1 + by_x**2 + by_z**2)
    measured = distance + noise_m * random.normal(size=len(distance))
    measured += 0.0 if ranges is None else ranges(distance, cosine)
    hit = (at[:, 0] > 0) & (at[:, 0] < WIDTH_M) & (at[:, 2] > 0) & (at[:, 2] < HEIGHT_M)
    return (eye + measured[:, None] * nominal)[hit] + UTM


def _rays(azimuth: FloatArray, zenith: FloatArray) -> FloatArray:
    """(n, 3) unit vectors."""
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)


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
