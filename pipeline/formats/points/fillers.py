"""Records that stand for no return: points at 0 0 0, or at one other place that far too many share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.point_cloud import PointCloud
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_SAMPLE = 4096
_ALIKE_IN_SAMPLE = 8
"""Points of the sample at one place from which on it is taken for a filler: 2 records in 1,000, where a scan rounded to
centimetres has a few at most."""
_GOLDEN = 0.6180339887498949


def without_fillers(cloud: PointCloud, where: str, *, grid: bool = False) -> PointCloud:
    """The cloud without records that stand for no return, with a note on them.

    Programs write 0 0 0, or one other place, for the pulses of a scan's grid that did not come back. A single record at 0 0 0 is
    left out where it lies outside of all others, and wherever it lies in the formats that have such grids.

    Parameters
    ----------
    cloud : points in the frame and the unit in which the file has them
    where : what errors call the file
    grid : whether the format holds cells of a scan's grid, as E57 and PTX do

    Raises
    ------
    InputError
        Where all records are 0 0 0.
    """
    points = cloud.points
    at_zero: NDArray[np.bool_] = np.asarray(~points.any(axis=1))
    count = int(at_zero.sum())
    if count and count == len(points):
        problem = f"all {count:,} records are 0 0 0, which stands for no return"
        raise InputError(problem, where=where, remedy="export the scan again, with its points")
    if count and (grid or count > 1 or _outside(points[~at_zero])):
        return without_fillers(_left_out(cloud, at_zero, "0 0 0"), where)
    place = _shared_place(points)
    if place is None:
        return cloud
    there = (points == place).all(axis=1)
    return cloud if there.all() else _left_out(cloud, there, " ".join(f"{value:.10g}" for value in place))


def _left_out(cloud: PointCloud, rows: NDArray[np.bool_], place: str) -> PointCloud:
    return cloud.part(~rows).noted(f"{int(rows.sum()):,} records at {place}, which stand for no return, are left out")


def _outside(others: FloatArray) -> bool:
    """Whether 0 0 0 lies outside of the box about the other points (n, 3)."""
    known = others[np.isfinite(others).all(axis=1)]
    return bool(len(known) and ((known.min(axis=0) > 0) | (known.max(axis=0) < 0)).any())


def _shared_place(points: FloatArray) -> FloatArray | None:
    """(3,) the place that far too many of the points (n, 3) share, None where there is none; by a sample spread over the file."""
    count = min(len(points), _SAMPLE)
    if not count:
        return None
    rows = np.arange(count) if count == len(points) else (np.arange(count) * _GOLDEN % 1 * len(points)).astype(np.int64)
    sample = points[rows]
    places, alike = np.unique(sample[np.isfinite(sample).all(axis=1)], axis=0, return_counts=True)
    return places[np.argmax(alike)] if len(alike) and alike.max() >= _ALIKE_IN_SAMPLE else None
