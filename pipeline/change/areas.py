"""Define areas of a wall, boxes or polygons, as given in configs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

Box = tuple[float, float, float, float]
Vertex = tuple[float, float]


def _check_shape(area: Any) -> Any:
    """Refuse anything that is neither a box nor a polygon."""
    try:
        corners = np.array(area, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.zeros(())
    shape = corners.shape
    if shape != (4,) and not (len(shape) == 2 and shape[0] >= 3 and shape[1] == 2):
        raise ValueError("is neither a box [x0, y0, x1, y1] nor a polygon [[x, y], [x, y], [x, y], ...]")
    if shape == (4,) and not (corners[:2] < corners[2:]).all():
        raise ValueError("is a box [x0, y0, x1, y1] without extent: x0 must be below x1 and y0 below y1")
    return area


Area = Annotated[Box | Annotated[tuple[Vertex, ...], Field(min_length=3)], BeforeValidator(_check_shape)]
"""A box (x0, y0, x1, y1) or the vertices of a polygon, wall frame, m."""


def in_areas(areas: Iterable[Area], x: FloatArray, y: FloatArray) -> NDArray[np.bool_]:
    """Return whether positions lie in one of several areas, such as those that are known to be stable.

    areas: boxes or polygons, wall frame, m. x, y: coordinates, any shape, wall frame, m.
    """
    found = np.zeros(np.shape(x), dtype=bool)
    for area in areas:
        corners = np.array(area, dtype=np.float64)
        if corners.shape == (4,):
            x0, y0, x1, y1 = corners
            found |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
        else:
            found |= _in_polygon(corners, x, y)
    return found


def check_some_inside(inside: NDArray[np.bool_], x: FloatArray, y: FloatArray, where: str) -> None:
    """Raise InputError if none of the user's areas contains a measured point.

    Parameters
    ----------
    inside : (n,) bool array
        Whether each place lies in an area.
    x, y : (n,) arrays
        Coordinates of the places, wall frame, m.
    where : str
        Option or file and key of the areas, for the error.
    """
    if inside.any() or not len(x):
        return
    wall = f"x {x.min():.1f} to {x.max():.1f} m and y {y.min():.1f} to {y.max():.1f} m"
    raise InputError(
        "no measured point lies in any of the areas",
        where=where,
        allowed=f"areas that hold points; the measured wall has {wall} in the wall frame",
        remedy="correct the coordinates of the areas: in the wall frame, x runs along the wall and y up the wall",
    )


def _in_polygon(corners: FloatArray, x: FloatArray, y: FloatArray) -> Any:
    """Return whether positions lie in a polygon, by the even-odd rule: how many sides a ray to the right crosses."""
    found = np.zeros(np.shape(x), dtype=bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crosses = (y0 > y) != (y1 > y)
        found ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / ((y1 - y0) or 1.0))
    return found
