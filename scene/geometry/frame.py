"""Define the wall frame: XY is the wall's mean plane or another plane, z points towards the sensors, y up the wall.

The origin lies at the lower corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from scene.common.config import Config
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_VERTICAL_LIMIT = 1e-3
"""Below this sine between the wall's normal and the vertical there is no direction up the wall (a floor or a roof)."""


class FrameConfig(Config):
    """Which way the wall frame's z axis points: difference maps show the change along it."""

    normal: Literal["mean_plane", "sensor"] | tuple[float, float, float] = Field(
        "mean_plane",
        description="z axis of the wall frame: the normal of the mean plane of all vertices (mean_plane), the line from the "
        "middle of the mesh to the sensor (sensor; for terrain that no plane fits), or a direction x, y, z in world coordinates",
    )

    def fit(self, vertices: FloatArray, towards: FloatArray) -> WallFrame:
        """Fit the frame to the vertices (n, 3) of a wall; towards: (3,) where the sensors stand; both world, m.

        Raises InputError where the vertices span no plane, and for a direction without length or away from the sensors.
        """
        if self.normal == "mean_plane":
            return WallFrame.fit(vertices, towards)
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        normal = towards - middle if self.normal == "sensor" else np.array(self.normal, dtype=np.float64)
        if not 0 < np.linalg.norm(normal) < np.inf:
            raise InputError(f"got {self.normal}", where="frame.normal", allowed="a direction x, y, z that is not zero")
        if np.dot(towards - middle, normal) < 0:
            remedy = "change its sign: the wall frame's z axis points towards the sensors"
            raise InputError(f"{self.normal} points away from the sensors", where="frame.normal", remedy=remedy)
        return WallFrame.along(normal / np.linalg.norm(normal), vertices)


@dataclass(frozen=True)
class WallFrame:
    """A rigid transform between the world (the survey's frame, m) and the wall frame: x_wall = R (x_world - origin).

    rotation: (3, 3), rows are the wall's axes in world coordinates; origin: (3,) of the wall frame, in world coordinates.
    Subtracting the origin first keeps micrometres with UTM-sized coordinates.
    """

    rotation: FloatArray
    origin: FloatArray

    @classmethod
    def fit(cls, vertices: FloatArray, towards: FloatArray) -> WallFrame:
        """Fit the mean plane by SVD to all vertices.

        vertices: (n, 3), world, m; towards: (3,) a point on the sensors' side of the wall, world, m.
        The origin lies in the mean plane at the smallest x and y. Raises InputError where the vertices span no plane.
        """
        centre = vertices.mean(axis=0)
        local = vertices - centre
        covariance = np.einsum("ni,nj->ij", local, local) / len(local)  # the SVD of 3 x 3: same axes, no (n, n) matrix
        axes, variances, _ = np.linalg.svd(covariance)
        if not variances[1] > 1e-12 * max(variances[0], 1e-300):
            raise InputError("the vertices lie on one line, so there is no mean plane", where="wall mesh")
        normal = axes[:, 2]
        return cls.along(normal if np.dot(np.asarray(towards) - centre, normal) >= 0 else -normal, vertices)

    @classmethod
    def along(cls, normal: FloatArray, vertices: FloatArray, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> WallFrame:
        """Make the frame whose z axis is `normal` and whose y axis points up the wall.

        normal: (3,) unit vector, world; vertices: (n, 3), world, m; up: the vertical. The origin lies in the plane through the
        mean of the vertices, at their smallest x and y.
        """
        centre = vertices.mean(axis=0)
        local = vertices - centre
        upward = np.asarray(up, dtype=float) - np.dot(up, normal) * normal
        if np.linalg.norm(upward) < _VERTICAL_LIMIT:  # a horizontal surface: take the world's y
            upward = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
        y_axis = upward / np.linalg.norm(upward)
        rotation = np.stack([np.cross(y_axis, normal), y_axis, normal])
        corner = np.append(np.einsum("ij,nj->ni", rotation[:2], local).min(axis=0), 0.0)
        return cls(rotation, centre + rotation.T @ corner)

    @classmethod
    def identity(cls) -> WallFrame:
        return cls(np.eye(3), np.zeros(3))

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) homogeneous transform, world to wall."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = -self.rotation @ self.origin
        return matrix

    def to_wall(self, points: FloatArray) -> FloatArray:
        """(..., 3) world to wall, m."""
        return np.einsum("ij,...j->...i", self.rotation, points - self.origin)

    def to_world(self, points: FloatArray) -> FloatArray:
        """(..., 3) wall to world, m."""
        return np.einsum("ji,...j->...i", self.rotation, points) + self.origin

    def direction_to_wall(self, directions: FloatArray) -> FloatArray:
        """(..., 3) directions, world to wall: rotated, not moved."""
        return np.einsum("ij,...j->...i", self.rotation, directions)
