"""Cover a wall with snow or growing vegetation, as thicknesses on top of the rock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scene.appearance.texture import solid_noise
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.upload import vectors_on_device

_STEEPEST, _FLATTEST = float(np.cos(np.radians(55.0))), float(np.cos(np.radians(35.0)))
"""Cosines of the slopes between which snow thins out to nothing."""
_LEAF_M, _PATCH_M = 0.08, 1.5
"""Grain of the leaves, and of the patches in which they grow, m."""


@dataclass(frozen=True)
class Cover:
    """Snow and vegetation on the rock at one epoch.

    Attributes
    ----------
    snow_m : float
        Vertical thickness of snow on level rock, m; none lies on rock steeper than 55 degrees.
    vegetation_m : float
        Height of the highest leaves above the rock, m; they grow in patches on about half of the wall.
    """

    snow_m: float = 0.0
    vegetation_m: float = 0.0

    def on(self, mesh: TriangleMesh, up: FloatArray, random: KeyedRandom) -> TriangleMesh:
        """Return the wall with the thickness of its snow and vegetation added to the rock, as a sensor meets it.

        Parameters
        ----------
        mesh : TriangleMesh
            The rock.
        up : (3,) array
            Unit vector against gravity, in the mesh's frame.
        random : KeyedRandom
            Source of the random places where plants grow.
        """
        if self.snow_m <= 0 and self.vegetation_m <= 0:
            return mesh
        normals = np.nan_to_num(mesh.vertex_normals())
        vertices = mesh.vertices
        if self.vegetation_m > 0:
            patches, leaves = (
                solid_noise(vectors_on_device(mesh.vertices / grain), 1.0, random.child(name).key & 0xFFFFFFFF).numpy()
                for name, grain in (("patches", _PATCH_M), ("leaves", _LEAF_M))
            )
            height = np.clip(patches / max(float(np.abs(patches).max()), 1e-9), 0, None) * np.abs(leaves)
            vertices = vertices + normals * (self.vegetation_m * height / max(float(height.max()), 1e-9))[:, None]
        if self.snow_m > 0:
            share = np.clip((normals @ up - _STEEPEST) / (_FLATTEST - _STEEPEST), 0, 1)
            vertices = vertices + up * (self.snow_m * share * share * (3 - 2 * share))[:, None]
        return mesh.with_vertices(vertices)
