"""Point clouds as photogrammetry makes them, in closed form with NumPy alone: nothing here comes from `sensors` or `pipeline`.

The wall is y = f(x, z), a sum of sines, in upright world axes: x along the wall, z up, y into the rock. Points lie on it, moved
along its normal by noise and by the effects of a case; the reference is a mesh of the same function.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
WIDTH, HEIGHT = 24.0, 16.0
SIGMA = 0.004
_RNG = np.random.default_rng(7)
_WAVES = [(*_RNG.uniform(0.15, 0.8, 1), *_RNG.uniform(0, 2 * np.pi, 2)) for _ in range(14)]


def depth(x: Array, z: Array) -> Array:
    """Return how far the wall lies behind y = 0, m."""
    total = np.zeros(np.broadcast(x, z).shape)
    for k, angle, phase in _WAVES:
        total += 0.15 / (0.2 + k) * np.sin(k * (np.cos(angle) * x + np.sin(angle) * z) + phase)
    return total


def normals(x: Array, z: Array) -> Array:
    """Return unit normals (n, 3) towards the air (-y)."""
    h = 1e-4
    by_x, by_z = (depth(x + h, z) - depth(x - h, z)) / (2 * h), (depth(x, z + h) - depth(x, z - h)) / (2 * h)
    found = np.stack([by_x, -np.ones_like(x), by_z], axis=1)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@dataclass(frozen=True)
class CloudCase:
    """What a cloud is like.

    above: function of (x, z) that returns the height above the wall along the normal, m; scale: scale of the cloud about the
    wall's centre; niche: x, z and depth of a square niche of 1 m; sigma: noise, m; points: number of points; moved, turn_rad:
    shift (m) and rotation of the cloud.
    """

    above: Callable[[Array, Array], Array] | None = None
    scale: float = 1.0
    niche: tuple[float, float, float] | None = None
    sigma: float = SIGMA
    points: int = 12_000
    moved: tuple[float, float, float] = (0.03, -0.02, 0.025)
    turn_rad: float = 0.002


def cloud(seed: int, **how: Any) -> Array:
    """Return points (n, 3) of a `CloudCase` with these fields."""
    case = CloudCase(**how)
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(0, WIDTH, case.points), rng.uniform(0, HEIGHT, case.points)
    off = case.sigma * rng.standard_normal(case.points)
    if case.above is not None:
        off = off + case.above(x, z)
    if case.niche is not None:
        inside = (np.abs(x - case.niche[0]) < 0.5) & (np.abs(z - case.niche[1]) < 0.5)
        off = off - case.niche[2] * inside * np.abs(normals(x, z)[:, 1])
    points = np.stack([x, depth(x, z), z], axis=1) + off[:, None] * normals(x, z)
    middle = np.array([WIDTH / 2, 0.0, HEIGHT / 2])
    c, s = np.cos(case.turn_rad), np.sin(case.turn_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return case.scale * (points - middle) @ turn.T + middle + np.array(case.moved)


def write_wall(path: Path, step: float = 0.05, beyond: float = 0.5, shift: tuple[float, float, float] = (0, 0, 0)) -> None:
    """Write the reference: a PLY mesh of the wall, larger than the cloud by `beyond` on each side."""
    xs, zs = np.arange(-beyond, WIDTH + beyond, step), np.arange(-beyond, HEIGHT + beyond, step)
    x, z = np.meshgrid(xs, zs, indexing="ij")
    vertices = np.stack([x, depth(x, z), z], axis=-1).reshape(-1, 3) + np.array(shift)
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    record = np.zeros(len(faces), dtype=[("n", "u1"), ("v", "<i4", (3,))])
    record["n"], record["v"] = 3, faces
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(head.encode() + vertices.astype("<f8").tobytes() + record.tobytes())


def write_cloud(path: Path, points: Array) -> None:
    """Write a PLY cloud without triangles."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\nproperty double x\nproperty double y\n"
        "property double z\nend_header\n"
    )
    path.write_bytes(head.encode() + points.astype("<f8").tobytes())
