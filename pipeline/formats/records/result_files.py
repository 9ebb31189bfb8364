"""Read surfaces and points of a run's folder, with checks: not empty, finite, and within a survey's coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.points import check_reach
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh

_REMEDY = "make the run again with scarpsim simulate, in another folder"


def read_surface(path: Path) -> TriangleMesh:
    """Read a surface of a run from a PLY file.

    Raises InputError as `read_ply` does, and for an empty one or impossible coordinates.
    """
    mesh = read_ply(path)
    if not len(mesh.faces):
        raise InputError("the file has no triangles", where=str(path), remedy=_REMEDY)
    _check(mesh.vertices, "vertices", path)
    return mesh


def read_own_points(path: Path) -> PointCloud:
    """Read the points of a run from a LAZ file.

    Raises InputError as `read_laz` does, and for no points or impossible coordinates.
    """
    from pipeline.formats.points.laz import read_laz  # laspy takes a fifth of a second to load

    cloud = read_laz(path)
    if not len(cloud.points):
        raise InputError("the file has no points", where=str(path), remedy=_REMEDY)
    _check(cloud.points, "points", path)
    return cloud


def _check(places: FloatArray, what: str, path: Path) -> None:
    """Raise InputError for coordinates that are not finite or too large."""
    if not np.isfinite(places).all():
        raise InputError(f"the file has {what} with coordinates that are not numbers", where=str(path), remedy=_REMEDY)
    check_reach(places, str(path))
