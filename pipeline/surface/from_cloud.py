"""Make a wall from a point cloud (`scarpsim surface`), by triangulation as seen from the scanner or by Poisson reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.finite import finite
from pipeline.surface.mesh import SurfaceConfig, median_spacing, mesh_cloud
from pipeline.surface.triangulation import triangulate_seen_points
from scene.common.config import Config
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.meshes.rounding import check_steps, rounded_axes

_FARTHEST = 50.0
"""Distance in extents of the cloud beyond which the viewpoint is probably in another coordinate system."""
_SAME_PLACE_M = 1e-6
"""Points closer than this to the viewpoint have no direction, m."""
_VERTICAL = np.array([0.0, 0.0, 1.0])
_STEEP = 0.99
"""Cosine between line of sight and vertical above which the vertical gives no up direction in the scanner's view."""


class CloudConfig(Config):
    """How a triangle mesh is made from a point cloud whose points are in no order."""

    method: Literal["triangulation", "poisson"] = Field(
        "triangulation",
        description="triangulation: Delaunay triangles between the points as seen by the scanner, cut at depth steps and holes; "
        "poisson: Open3D's Poisson reconstruction, for points that are seen from several sides",
    )
    poisson_depth: int | None = Field(
        None, ge=4, le=16, description="depth of the octree; null: cells as large as the points' spacing"
    )
    poisson_trim_spacings: float = Field(
        3.0, gt=0, description="the Poisson surface ends this many median point spacings from the nearest point"
    )


@dataclass(frozen=True)
class CloudSurface:
    """Hold the triangle mesh made from a point cloud, and remarks on the cloud to show to the user.

    Attributes
    ----------
    mesh : TriangleMesh
        The mesh in the cloud's frame, m.
    notes : tuple of str
        The remarks as sentences, for example that coordinates are coarsely rounded.
    """

    mesh: TriangleMesh
    notes: tuple[str, ...]


def surface_of_cloud(cloud: PointCloud, viewpoint: FloatArray, config: CloudConfig, where: str) -> CloudSurface:
    """Make a triangle mesh from a point cloud whose points are in no order, in the cloud's own frame.

    The triangles face the sensor. Large coordinates lose no precision, because whole metres are subtracted and added again.

    Parameters
    ----------
    cloud : PointCloud
        The points, m.
    viewpoint : (3,) array
        Position of the sensor, in the cloud's frame, m.
    config : CloudConfig
        The method (triangulation or Poisson reconstruction) and its settings.
    where : str
        Name of the cloud in error messages.

    Raises
    ------
    InputError
        If no surface can be made of the points, if their coordinates were rounded too coarsely, or if the viewpoint is far
        from them.
    """
    points = finite(cloud, where).points
    middle = np.median(points, axis=0)
    origin = np.floor(middle)
    away = float(np.linalg.norm(viewpoint - middle))
    extent = float(np.ptp(points, axis=0).max())
    if away > _FARTHEST * max(extent, 1.0):
        raise InputError(
            f"the sensor's place lies {away:,.0f} m from the points, which extend over only {extent:,.0f} m",
            where="--seen-from",
            remedy="give the sensor's x, y, z in the coordinate system of the points",
        )
    rounded = rounded_axes(points)
    notes = check_steps(rounded, median_spacing(points - origin), where, "the points' spacing is") if rounded else ()
    local, eye = points - origin, viewpoint - origin
    mesh = _triangulation(local, eye, where) if config.method == "triangulation" else _poisson(local, eye, config)
    return CloudSurface(TriangleMesh(mesh.vertices + origin, mesh.faces), notes)


def _triangulation(points: FloatArray, viewpoint: FloatArray, where: str) -> TriangleMesh:
    """Triangulate the points as seen from the viewpoint. Raises InputError for points at the viewpoint itself."""
    apart = np.linalg.norm(points - viewpoint, axis=1) > _SAME_PLACE_M
    if not apart.all():
        raise InputError(
            f"{int((~apart).sum()):,} points lie where the sensor stands",
            where=where,
            remedy="remove these points, or give the sensor's place with --seen-from",
        )
    return triangulate_seen_points(points, viewpoint, _looking_at(np.median(points, axis=0) - viewpoint), where).mesh


def _looking_at(direction: FloatArray) -> FloatArray:
    """Return a rotation (3, 3), local to cloud frame, whose x axis points along `direction` (3,).

    No pole of the polar angles is then in view.
    """
    length = np.linalg.norm(direction)
    forward = direction / length if length > 0 else np.array([1.0, 0.0, 0.0])
    up = _VERTICAL if abs(forward[2]) < _STEEP else np.array([0.0, 1.0, 0.0])
    side = np.cross(up, forward)
    side /= np.linalg.norm(side)
    return np.stack([forward, side, np.cross(forward, side)], axis=1)


def _poisson(points: FloatArray, viewpoint: FloatArray, config: CloudConfig) -> TriangleMesh:
    """Reconstruct the surface with Open3D."""
    block = np.zeros(len(points), dtype=np.int32)
    settings = SurfaceConfig(
        method="poisson", poisson_depth=config.poisson_depth, poisson_trim_spacings=config.poisson_trim_spacings
    )
    return mesh_cloud(points, block, viewpoint, settings)
