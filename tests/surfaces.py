"""Surfaces with closed forms, for the tests: planes, spheres, a step edge, a rough heightfield."""

from __future__ import annotations

import numpy as np
import trimesh

from scene.geometry.mesh import FloatArray, TriangleMesh


def plane(normal: FloatArray, point: FloatArray, half_side: float = 40.0) -> TriangleMesh:
    """Two triangles of the plane through `point`, facing along `normal`."""
    normal = normal / np.linalg.norm(normal)
    first = np.cross(normal, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    corners = [point + half_side * (a * first + b * second) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return TriangleMesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def sphere(centre: FloatArray, radius: float, subdivisions: int = 6) -> TriangleMesh:
    """A sphere of 20 * 4^subdivisions triangles with its vertices on the sphere, facing outwards."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return TriangleMesh(np.asarray(ball.vertices, dtype=float) + centre, np.asarray(ball.faces, dtype=np.int32))


def step(near: float, far: float, half_side: float = 40.0) -> TriangleMesh:
    """Two half planes of constant z: `near` for x > 0, `far` for x < 0; nothing joins them."""
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=np.int32)
    corners = [
        (x, y, z) for low, high, z in ((0.0, half_side, near), (-half_side, 0.0, far)) for x, y in _square(low, high, half_side)
    ]
    return TriangleMesh(np.array(corners), faces)


def _square(low: float, high: float, half_side: float) -> list[tuple[float, float]]:
    return [(low, -half_side), (high, -half_side), (high, half_side), (low, half_side)]


def heightfield(width: float, height: float, spacing: float, roughness: float = 0.1, seed: int = 0) -> TriangleMesh:
    """A rough heightfield from (0, 0) to (width, height), facing +z; several sines with random directions and phases."""
    columns, rows = round(width / spacing) + 1, round(height / spacing) + 1
    x, y = np.meshgrid(np.linspace(0, width, columns), np.linspace(0, height, rows))
    random = np.random.default_rng(seed)
    z = np.zeros_like(x)
    for wavelength in (8.0, 3.0, 1.2, 0.5):
        angle, phase = random.uniform(0, 2 * np.pi, 2)
        z += roughness * wavelength / 4 * np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / wavelength + phase)
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return TriangleMesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces)
