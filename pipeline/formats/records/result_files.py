"""Surfaces and points of a run's folder as commands read them again: not empty, of numbers, near enough to be a survey's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.formats.meshes.ply import read_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import read_laz
from pipeline.formats.points.points import check_reach
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh

_REMEDY = "make the run again"


def read_surface(path: Path) -> TriangleMesh:
    """A surface (PLY); raises InputError as `read_ply` does, and for none and coordinates that are no survey's."""
    mesh = read_ply(path)
    if not len(mesh.faces):
        raise InputError("holds no triangle", where=str(path), remedy=_REMEDY)
    _check(mesh.vertices, "vertices", path)
    return mesh


def read_own_points(path: Path) -> PointCloud:
    """Points (LAZ); raises InputError as `read_laz` does, and for none and coordinates that are no survey's."""
    cloud = read_laz(path)
    if not len(cloud.points):
        raise InputError("holds no points", where=str(path), remedy=_REMEDY)
    _check(cloud.points, "points", path)
    return cloud


def _check(places: FloatArray, what: str, path: Path) -> None:
    if not np.isfinite(places).all():
        raise InputError(f"has {what} that are no numbers", where=str(path), remedy=_REMEDY)
    check_reach(places, str(path))
