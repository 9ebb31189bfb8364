"""Remove points without finite values from a cloud, and refuse clouds that hold no surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.geometry.bounds import bounding_box
from scene.geometry.mesh import FloatArray

_SAMPLE = 20_000
"""Number of points in the sample."""
_ONE_PLACE_M = 1e-6
"""Points within this distance are at the same place, m."""
_LINE_POINTS = 10
"""Number of points from which lying on one line is not a coincidence."""


def finite(cloud: PointCloud, where: str) -> PointCloud:
    """Return the points of a cloud without those that have NaN or infinity as a coordinate, intensity, time or pixel.

    where: name of the file, for errors. Raises InputError if no points remain, or all are at one place or on one line.
    """
    channels = [cloud.intensity, cloud.gps_time, *(cloud.extra.get(name) for name in ("pixel_x", "pixel_y"))]
    points = cloud.points
    box = bounding_box(points) if len(points) else np.full((2, 3), np.nan)
    all_finite = bool(np.isfinite(box).all())
    keep: NDArray[np.bool_] = np.ones(len(points), dtype=bool) if all_finite else np.asarray(np.isfinite(points).all(axis=1))
    for channel in channels:
        if channel is not None:
            keep = keep & np.isfinite(channel)
    if not keep.any():
        problem = (
            f"the cloud has no point with finite values ({len(keep):,} are NaN or infinite)"
            if len(keep)
            else "the cloud has no points"
        )
        raise InputError(problem, where=where, remedy="export the points again, with numbers for all coordinates and channels")
    if not keep.all():
        cloud = cloud.part(keep)
        box = bounding_box(cloud.points)
    count = len(cloud.points)
    if count > 1 and (box[1] - box[0]).max() < _ONE_PLACE_M:
        raise InputError(
            f"all {count:,} points are at the same place",
            where=where,
            remedy="export the points again with all decimals of their coordinates",
        )
    if count >= _LINE_POINTS and _on_a_line(cloud.points):
        raise InputError(
            f"all {count:,} points lie on one line",
            where=where,
            remedy="give a scan of a surface, whose points spread in two directions",
        )
    return cloud


def _on_a_line(points: FloatArray) -> bool:
    """Whether a sample of points (n, 3) deviates from a line by no more than rounding."""
    away = points[:: max(len(points) // _SAMPLE, 1)]
    away = away - away[len(away) // 2]
    axis = away[np.argmax(np.einsum("ni,ni->n", away, away))]
    beside = away - np.outer(away @ axis / (axis @ axis), axis)
    return bool(np.linalg.norm(beside, axis=1).max() < max(_ONE_PLACE_M, 1e-9 * np.abs(bounding_box(points)).max()))
