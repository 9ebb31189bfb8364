"""Synthetic walls for the tests of carving and placement."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from scene.geometry.mesh import TriangleMesh


def grid_wall(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> TriangleMesh:
    """Return a wall over a regular grid; x, y, z: (rows, columns), m, columns along x."""
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (number[rows, columns].ravel() for rows, columns in CORNERS)
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return TriangleMesh(np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(float), faces)


LOW, HIGH = slice(None, -1), slice(1, None)
CORNERS = [(LOW, LOW), (LOW, HIGH), (HIGH, HIGH), (HIGH, LOW)]


def plane_wall(width_m: float, height_m: float, slope: float = 0.0, cell_m: float = 0.1) -> TriangleMesh:
    """Return the plane z = slope * x over [0, width] x [0, height]."""
    x, y = np.meshgrid(np.arange(0, width_m + cell_m / 2, cell_m), np.arange(0, height_m + cell_m / 2, cell_m))
    return grid_wall(x, y, slope * x)


def rough_wall(width_m: float, height_m: float, cell_m: float, seed: int = 0) -> TriangleMesh:
    """Return a wall with relief of some decimetres over metres, and of a fifth of a cell from vertex to vertex."""
    x, y = np.meshgrid(np.arange(0, width_m, cell_m), np.arange(0, height_m, cell_m))
    random = np.random.default_rng(seed)
    relief = ndimage.gaussian_filter(random.normal(size=x.shape), 1.0 / cell_m)
    return grid_wall(x, y, 0.15 * relief / relief.std() + 0.2 * cell_m * random.normal(size=x.shape))


def closed(wall: TriangleMesh, thickness_m: float) -> TriangleMesh:
    """Return a grid wall closed to a solid by a copy behind it and sides."""
    directed = {(a, b) for face in wall.faces.tolist() for a, b in zip(face, face[1:] + face[:1], strict=True)}
    start, end = np.array([edge for edge in sorted(directed) if edge[::-1] not in directed]).T
    count = len(wall.vertices)
    sides = [(end, start, start + count), (end, start + count, end + count)]
    back = wall.vertices - [0, 0, thickness_m]
    faces = [wall.faces, wall.faces[:, ::-1] + count, *(np.stack(side, axis=1) for side in sides)]
    return TriangleMesh(np.concatenate([wall.vertices, back]), np.concatenate(faces).astype(np.int32))
