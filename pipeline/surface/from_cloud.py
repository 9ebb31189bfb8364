"""Make a wall from a point cloud (`scarpsim surface`): a triangulation seen from the scanner, or Poisson reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from pipeline.formats.measurements.checks import finite
from pipeline.formats.point_cloud import PointCloud
from pipeline.surface.mesh import SurfaceConfig, median_spacing, mesh_cloud
from pipeline.surface.triangulation import triangulated
from scene.common.config import Config
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.meshes.rounding import check_steps, rounded_axes

_FARTHEST = 50.0
"""Extents of the cloud beyond which the place to look from is likely in another coordinate system."""
_SAME_PLACE_M = 1e-6
_VERTICAL = np.array([0.0, 0.0, 1.0])
_STEEP = 0.99
"""Cosine between line of sight and vertical above which the vertical gives no direction up in the scanner's view."""


class CloudConfig(Config):
    """How an unorganised point cloud becomes a surface."""

    method: Literal["triangulation", "poisson"] = Field(
        "triangulation",
        description="triangulation: Delaunay triangles between the points as the scanner sees them, cut at steps and holes; "
        "poisson: Open3D's Poisson reconstruction, for points that are seen from several sides",
    )
    poisson_depth: int | None = Field(
        None, ge=4, le=16, description="depth of the octree; null: its cells as large as the points' spacing"
    )
    poisson_trim_spacings: float = Field(
        3.0, gt=0, description="the Poisson surface ends this many median point spacings from the nearest point"
    )


@dataclass(frozen=True)
class CloudSurface:
    """A surface made from a cloud. mesh: in the cloud's frame, m; notes: what the user should know of the points, in words."""

    mesh: TriangleMesh
    notes: tuple[str, ...]


def surface_of_cloud(cloud: PointCloud, viewpoint: FloatArray, config: CloudConfig, where: str) -> CloudSurface:
    """Make the surface through unorganised points, in their own frame. Its faces look to the viewpoint.

    Parameters
    ----------
    cloud : PointCloud
        The points, m. Coordinates of any size lose nothing: whole metres are taken off and added again.
    viewpoint : (3,) array
        Where a sensor stood, in the cloud's frame, m.
    config : CloudConfig
        The method and its settings.
    where : str
        What errors call the cloud.

    Returns
    -------
    CloudSurface

    Raises
    ------
    InputError
        For points of which no surface can be made, coordinates that were rounded more than the surface can bear, and a viewpoint
        that is far from the points.
    """
    points = finite(cloud, where).points
    middle = np.median(points, axis=0)
    origin = np.floor(middle)
    away = float(np.linalg.norm(viewpoint - middle))
    extent = float(np.ptp(points, axis=0).max())
    if away > _FARTHEST * max(extent, 1.0):
        raise InputError(
            f"lies {away:,.0f} m from the points, which extend over {extent:,.0f} m",
            where="--seen-from",
            remedy="give it in the coordinates of the points",
        )
    rounded = rounded_axes(points)
    notes = check_steps(rounded, median_spacing(points - origin), where, "the points' spacing is") if rounded else ()
    local, eye = points - origin, viewpoint - origin
    mesh = _triangulation(local, eye, where) if config.method == "triangulation" else _poisson(local, eye, config)
    return CloudSurface(TriangleMesh(mesh.vertices + origin, mesh.faces), notes)


def _triangulation(points: FloatArray, viewpoint: FloatArray, where: str) -> TriangleMesh:
    apart = np.linalg.norm(points - viewpoint, axis=1) > _SAME_PLACE_M
    if not apart.all():
        problem = f"{int((~apart).sum()):,} points lie where the sensor stands"
        raise InputError(problem, where=where, remedy="remove these points, or give the sensor's place with --seen-from")
    return triangulated(points, viewpoint, _looking_at(np.median(points, axis=0) - viewpoint), where).mesh


def _looking_at(direction: FloatArray) -> FloatArray:
    """(3, 3) local to cloud frame, whose x axis points along `direction` (3,), so that no pole of the angles lies in the view."""
    length = np.linalg.norm(direction)
    forward = direction / length if length > 0 else np.array([1.0, 0.0, 0.0])
    up = _VERTICAL if abs(forward[2]) < _STEEP else np.array([0.0, 1.0, 0.0])
    side = np.cross(up, forward)
    side /= np.linalg.norm(side)
    return np.stack([forward, side, np.cross(forward, side)], axis=1)


def _poisson(points: FloatArray, viewpoint: FloatArray, config: CloudConfig) -> TriangleMesh:
    block = np.zeros(len(points), dtype=np.int32)
    settings = SurfaceConfig(
        method="poisson", poisson_depth=config.poisson_depth, poisson_trim_spacings=config.poisson_trim_spacings
    )
    return mesh_cloud(points, block, viewpoint, settings)
