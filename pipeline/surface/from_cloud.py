"""A wall out of a point cloud: what `scarpsim surface` does."""

from __future__ import annotations

import numpy as np

from pipeline.formats.measurements.checks import finite
from pipeline.formats.point_cloud import PointCloud
from pipeline.surface.mesh import SurfaceConfig, mesh_cloud
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh

_FARTHEST = 50.0
"""Extents of the cloud beyond which the place to look from is likely in another coordinate system."""


def surface_of_cloud(cloud: PointCloud, viewpoint: FloatArray, config: SurfaceConfig, where: str) -> TriangleMesh:
    """The surface through unorganised points, by Poisson reconstruction, in their own frame; its faces look to the viewpoint.

    viewpoint: (3,) in the cloud's frame, m: where a sensor stood; where: what errors call the cloud. Coordinates of any size
    lose nothing: whole metres are taken off and added again. Raises InputError for a viewpoint that cannot be one.
    """
    points = finite(cloud, where).points
    origin = np.floor(np.median(points, axis=0))
    away = float(np.linalg.norm(viewpoint - np.median(points, axis=0)))
    extent = float(np.ptp(points, axis=0).max())
    if away > _FARTHEST * max(extent, 1.0):
        raise InputError(
            f"lies {away:,.0f} m from the points, which extend over {extent:,.0f} m",
            where="--seen-from",
            remedy="give it in the coordinates of the points",
        )
    block = np.zeros(len(points), dtype=np.int32)
    found = mesh_cloud(points - origin, block, viewpoint - origin, config)
    return TriangleMesh(found.vertices + origin, found.faces)
