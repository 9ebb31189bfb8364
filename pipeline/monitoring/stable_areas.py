"""Define areas of stable rock, given on the map of the wall or in survey coordinates, and find the points in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from pipeline.change.areas import Area, in_areas
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

_DEPTH = 0.5
"""Distance from the plane of a polygon in survey coordinates up to which points are in it, over the polygon's largest extent."""

Position = tuple[float, float, float]
SurveyBox = tuple[float, float, float, float, float, float]


def _check_shape(area: Any) -> Any:
    """Refuse anything that is neither a box nor a polygon in three dimensions."""
    try:
        shape = np.array(area, dtype=np.float64).shape
    except (TypeError, ValueError):
        shape = ()
    if shape != (6,) and not (len(shape) == 2 and shape[0] >= 3 and shape[1] == 3):
        raise ValueError("is neither a box [x0, y0, z0, x1, y1, z1] nor a polygon [[x, y, z], [x, y, z], [x, y, z], ...]")
    return area


SurveyArea = Annotated[SurveyBox | Annotated[tuple[Position, ...], Field(min_length=3)], BeforeValidator(_check_shape)]
"""A box (x0, y0, z0, x1, y1, z1) or the vertices of a nearly flat polygon, survey coordinates, m."""
StableArea = Area | SurveyArea
"""An area on the map, wall frame, or one in survey coordinates, which can lie on any view of a wall with several views."""


@dataclass(frozen=True)
class StableRock:
    """Areas of stable rock that the user gave.

    Attributes
    ----------
    areas : tuple of StableArea
        The areas; empty if the user gave none.
    frame : WallFrame
        The wall frame.
    """

    areas: tuple[StableArea, ...]
    frame: WallFrame

    def __bool__(self) -> bool:
        """Whether the user gave any area."""
        return bool(self.areas)

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return which of the points (n, 3), wall frame, m, lie in one of the areas, as a mask (n,).

        Areas in x and y of the wall frame reach through all depths of the wall. A polygon in survey coordinates contains points
        that lie in it when seen along its normal, and no farther from its plane than half of its extent.
        """
        world = self.frame.to_world(points)
        found = np.zeros(len(points), dtype=bool)
        for area in self.areas:
            corners = np.array(area, dtype=np.float64)
            if corners.shape == (6,):
                low, high = np.sort(corners.reshape(2, 3), axis=0)
                found |= ((world >= low) & (world <= high)).all(axis=1)
            elif corners.ndim == 2 and corners.shape[1] == 3:
                found |= _in_survey_polygon(corners, world)
            else:
                found |= in_areas([area], points[:, 0], points[:, 1])  # type: ignore[list-item]  # by its shape
        return found


def _in_survey_polygon(corners: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """(n,) which points lie in a polygon (k, 3) seen along the normal of its plane, and near this plane."""
    centre = corners.mean(axis=0)
    axes = np.linalg.svd(corners - centre)[2]
    flat, local = ((each - centre) @ axes.T for each in (corners, points))
    near = np.abs(local[:, 2]) <= _DEPTH * np.ptp(flat[:, :2], axis=0).max()
    return near & in_areas([tuple((float(x), float(y)) for x, y in flat[:, :2])], local[:, 0], local[:, 1])
