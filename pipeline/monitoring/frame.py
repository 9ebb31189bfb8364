"""Choose the wall frame and the raster on which epochs are compared."""

from __future__ import annotations

import numpy as np

from pipeline.formats.point_cloud import PointCloud
from pipeline.measurement.scans import RawScan
from pipeline.measurement.station import find_station
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.reading import EpochData
from pipeline.monitoring.records import CAUTION
from scene.common.errors import InputError
from scene.geometry.bounds import bounding_box
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_SAMPLE = 200_000
"""Points that the mean plane is fitted to."""
_CELL_M, _POINTS_A_CELL, _ROUNDS = 0.5, 3.0, 3
"""Side of the cells by which the area that has points is counted: at first, m, then in distances of the points; and how often."""
_ALONE, _MOST_ROUNDS = 0.5, 20
"""Cells a point above which the cells are too small to count the area; rounds in all, in which they are enlarged."""
_POINTS_APART = 1.5
"""Pixel side over the mean distance of neighbouring points: 3 x 3 pixels then hold some twenty points."""
_MOST_COUNTED = 300_000
_ROUND = np.array([1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0])
_MOST_PIXELS = 60_000_000
_FINEST_M = 0.002


def towards_sensor(data: EpochData, options: MonitorOptions, name: str) -> tuple[FloatArray, str]:
    """Find a place in front of the wall, from which it is known which side of the wall is rock and which is air.

    Parameters
    ----------
    data : EpochData
        Content of the reference's file.
    options : MonitorOptions
        May state the sensor's position or the direction of change.
    name : str
        Name of the file, for errors.

    Returns
    -------
    ((3,) array, str)
        The place, survey coordinates, m, and in words how it is known.

    Raises
    ------
    InputError
        If neither the options, the file nor its scan lines tell from which side the wall was measured.
    """
    if options.position is not None:
        return options.position, "as given by --position"
    if data.position is not None:
        return data.position, "from the file"
    if options.direction is not None:
        return data.points.mean(axis=0) + options.direction, "by --direction"
    try:
        station = find_station(RawScan(name, PointCloud(data.in_order)))
    except InputError:
        raise InputError(
            "the file does not say from which side the wall was measured",
            where=name,
            remedy="give --position X,Y,Z: where the scanner stood, or any place before the wall, in the file's coordinates",
        ) from None
    return station.position, "where the scan lines meet"


def doubt_of_side(data: EpochData, options: MonitorOptions, frame: WallFrame, name: str) -> list[str]:
    """Return a caution if the position that the user gave lies behind the wall, as the file or its scan lines show.

    All changes would have the wrong sign then: what fell would be listed as added.

    Parameters
    ----------
    data : EpochData
        Content of the reference's file.
    options : MonitorOptions
        Has the position, if one was given.
    frame : WallFrame
        The wall frame, whose z axis points to the side of that position.
    name : str
        Name of the file.
    """
    if options.position is None or data.mesh is not None:
        return []
    seen, how = data.position, "the file states"
    if seen is None:
        try:
            seen, how = find_station(RawScan(name, PointCloud(data.in_order[:_SAMPLE]))).position, "the scan lines show"
        except InputError:
            return []
    if frame.to_wall(seen[None])[0, 2] > 0:
        return []
    place = ", ".join(f"{value:.2f}" for value in seen)
    return [
        f"{CAUTION}--position lies behind the wall, as {how} that the scanner stood on its other side, at ({place}): if they are "
        "right, missing rock is listed as added and the other way round. Give that place with --position"
    ]


def wall_frame(points: FloatArray, towards: FloatArray, direction: FloatArray | None) -> WallFrame:
    """Fit the wall frame, whose z axis points from the wall to the sensor: changes are measured along it.

    Parameters
    ----------
    points : (n, 3) array
        Points of the wall, survey coordinates, m.
    towards : (3,) array
        A place in front of the wall, survey coordinates, m, which tells the sign of z.
    direction : (3,) array or None
        Direction of z, survey coordinates, of any length; None: the normal of the points' mean plane.

    Raises
    ------
    InputError
        If the direction has no length.
    """
    if direction is not None and not np.any(direction):
        raise InputError(
            "the direction has no length",
            where="--direction",
            allowed="three numbers that are not all 0",
            remedy="give the direction from the wall towards the sensor, in the coordinates of the files",
        )
    few = points[:: max(len(points) // _SAMPLE, 1)]
    if direction is None:
        return WallFrame.fit(few, towards)
    return WallFrame.along(direction / np.linalg.norm(direction), few)


def raster_of(points: FloatArray, gsd_m: float | None, count: int | None = None) -> Grid:
    """Choose the raster of a wall's maps so that it covers all points.

    Parameters
    ----------
    points : (n, 3) array
        Points, wall frame, m.
    gsd_m : float or None
        Side of a pixel, m; None: 1.5 times the mean distance of neighbouring points, rounded up.
    count : int, optional
        Number of points in the files, of which `points` are a sample; None: `points` are all.

    Raises
    ------
    InputError
        If the wall has fewer than ten pixels across, or the raster more than 60 million.
    """
    bounds = bounding_box(points)
    gsd = gsd_m if gsd_m is not None else _usual_gsd(points, count or len(points))
    width, height = (bounds[1] - bounds[0])[:2]
    coarsest, finest = min(width, height) / 10, float(np.sqrt(width * height / _MOST_PIXELS))
    if not finest <= gsd <= coarsest:
        raise InputError(
            f"a pixel of {gsd:g} m is too {'large' if gsd > coarsest else 'small'} for a wall of {width:.1f} x {height:.1f} m",
            where="--gsd",
            allowed=f"{finest:.2g} to {coarsest:.3g} m",
            remedy="choose a smaller pixel" if gsd > coarsest else "choose a larger pixel, or cut the epochs to the wall",
        )
    return Grid.over(bounds, gsd)


def _count_cells(points: FloatArray, side: float) -> int:
    """Return the number of squares of a grid in which points (n, 2) lie."""
    column, row = np.floor(points / side).astype(np.int64).T
    ordered = np.sort(column * (np.ptp(row) + 1) + row - row.min())
    return 1 + int(np.count_nonzero(ordered[1:] != ordered[:-1]))


def _usual_gsd(points: FloatArray, count: int) -> float:
    """Return a round pixel size, m, somewhat above the mean distance of neighbouring points."""
    few = points[:: len(points) // _MOST_COUNTED + 1, :2]
    apart, cell = _CELL_M, _CELL_M
    counted = 0
    for _ in range(_MOST_ROUNDS):
        cells = _count_cells(few, cell)
        apart = float(np.sqrt(cells * cell**2 / count))
        cell = _POINTS_A_CELL * apart * float(np.sqrt(count / len(few)))
        counted += cells <= _ALONE * len(few)
        if counted == _ROUNDS:
            break
    spacing = _POINTS_APART * apart
    power = 10.0 ** np.floor(np.log10(max(spacing, _FINEST_M)))
    return float(power * _ROUND[np.searchsorted(_ROUND, max(spacing, _FINEST_M) / power - 1e-9)])
