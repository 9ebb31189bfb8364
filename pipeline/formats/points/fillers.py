"""Remove records that stand for a missing return: points at 0 0 0, or at one other place that too many share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_SAMPLE = 4096
"""Number of points in the sample."""
_ALIKE_IN_SAMPLE = 8
"""Number of sampled points at one place from which it is a filler: 2 in 1,000 records. A scan rounded to centimetres has only a
few.
"""
_GOLDEN = 0.6180339887498949
"""Golden ratio, which spreads the sample over the file."""


def without_fillers(cloud: PointCloud, where: str, *, grid: bool = False) -> PointCloud:
    """Remove points that stand for a missing return of a laser pulse, and add a note on them to the cloud.

    Programs write 0 0 0, or another fixed place, for pulses without a return. Several points at 0 0 0 are always removed. A
    single one may be real: it is removed if the format stores missing returns, or if it lies outside the box of all others.

    Parameters
    ----------
    cloud : Points in the frame and the unit of the file.
    where : Name of the file, for errors.
    grid : Whether the format stores a grid of pulses with missing returns, like E57 and PTX.

    Raises
    ------
    InputError
        If all points are 0 0 0.
    """
    points = cloud.points
    at_zero: NDArray[np.bool_] = np.logical_and.reduce([column == 0 for column in points.T])
    count = int(at_zero.sum())
    if count and count == len(points):
        raise InputError(
            f"all {count:,} records are 0 0 0, which stands for no return",
            where=where,
            remedy="export the scan again, with its points",
        )
    if count and (grid or count > 1 or _outside(points[~at_zero])):
        return without_fillers(_left_out(cloud, at_zero, "0 0 0"), where)
    place = _shared_place(points)
    if place is None:
        return cloud
    there = (points == place).all(axis=1)
    return cloud if there.all() else _left_out(cloud, there, " ".join(f"{value:.10g}" for value in place))


def _left_out(cloud: PointCloud, rows: NDArray[np.bool_], place: str) -> PointCloud:
    """Return the cloud without some rows, with a note."""
    return cloud.part(~rows).noted(f"{int(rows.sum()):,} records at {place}, which stand for no return, are left out")


def _outside(others: FloatArray) -> bool:
    """Whether 0 0 0 is outside of the bounding box of the other points (n, 3)."""
    known = others[np.isfinite(others).all(axis=1)]
    return bool(len(known) and ((known.min(axis=0) > 0) | (known.max(axis=0) < 0)).any())


def _shared_place(points: FloatArray) -> FloatArray | None:
    """Return the (3,) place that too many of the points (n, 3) share, judged from a sample; None if there is none."""
    count = min(len(points), _SAMPLE)
    if not count:
        return None
    rows = np.arange(count) if count == len(points) else (np.arange(count) * _GOLDEN % 1 * len(points)).astype(np.int64)
    sample = points[rows]
    places, alike = np.unique(sample[np.isfinite(sample).all(axis=1)], axis=0, return_counts=True)
    return places[np.argmax(alike)] if len(alike) and alike.max() >= _ALIKE_IN_SAMPLE else None
