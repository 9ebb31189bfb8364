"""Cast rays against a triangle mesh with Open3D (Embree); hits are computed again in float64 on the plane of the triangle."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
AT_ONCE = 1_000_000
"""Rays in memory at a time with everything computed for them (some 300 bytes each)."""


class Surface:
    """A mesh for ray casting. vertices: (v, 3) m, within a few hundred metres of the origin; faces: (f, 3)."""

    def __init__(self, vertices: Array, faces: Any) -> None:
        self.vertices, self.faces = vertices, faces

    @cached_property
    def _scene(self) -> Any:
        import open3d as o3d

        scene, faces = o3d.t.geometry.RaycastingScene(), np.ascontiguousarray(self.faces, dtype=np.uint32)
        scene.add_triangles(o3d.core.Tensor(self.vertices.astype(np.float32)), o3d.core.Tensor(faces))
        return scene

    def cast(self, origin: Array, ray: Array) -> tuple[Array, Array]:
        """Cast rays (n, 3) from `origin`, (3,) or (n, 3), onto the surface.

        Returns distances (n,) in lengths of the rays, NaN without a hit, and unit normals (n, 3).
        """
        start = np.broadcast_to(origin, ray.shape)
        distance, normal = np.empty(len(ray)), np.empty(ray.shape)
        for first in range(0, len(ray), AT_ONCE):
            part = slice(first, first + AT_ONCE)
            distance[part], normal[part] = self._cast(start[part], ray[part])
        return distance, normal

    def _cast(self, start: Array, ray: Array) -> tuple[Array, Array]:
        import open3d as o3d

        found = self._scene.cast_rays(o3d.core.Tensor(np.concatenate([start, ray], axis=1).astype(np.float32)), nthreads=1)
        face = found["primitive_ids"].numpy().astype(np.int64)
        hit = np.isfinite(found["t_hit"].numpy())
        corner = self.vertices[self.faces[np.where(hit, face, 0)]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        along = np.einsum("ni,ni->n", ray, normal)
        distance = np.einsum("ni,ni->n", corner[:, 0] - start, normal) / np.where(along == 0, np.nan, along)
        return np.where(hit, distance, np.nan), normal
