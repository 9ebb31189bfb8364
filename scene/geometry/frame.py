"""Define the wall frame, in which all difference maps are made.

XY is the wall's mean plane or another plane, z points towards the sensors, y points up the wall, and the origin lies at the
wall's lower corner.
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
"""Sine of the angle between the wall's normal and the vertical below which the surface counts as a floor or a roof, with no
direction up the wall.
"""


class FrameConfig(Config):
    """The direction of the wall frame's z axis, along which difference maps measure change.

    The wall frame is a coordinate system whose z axis points out of the rock.
    """

    normal: Literal["mean_plane", "sensor"] | tuple[float, float, float] = Field(
        "mean_plane",
        description="z axis of the wall frame: the normal of the mean plane of all vertices (mean_plane), the line from the "
        "middle of the mesh to the sensor (sensor; for terrain that no plane fits), or a direction "
        "x, y, z in world coordinates",
    )

    def fit(self, vertices: FloatArray, towards: FloatArray) -> WallFrame:
        """Fit the wall frame (a coordinate system whose z axis points out of the rock) to a wall, as configured.

        Parameters
        ----------
        vertices : (n, 3) array
            Vertices of the wall, world frame, m.
        towards : (3,) array
            Position of the sensors, world frame, m.

        Raises
        ------
        InputError
            If the vertices do not span a plane, or if the configured direction has no length or points away from the sensors.
        """
        if self.normal == "mean_plane":
            return WallFrame.fit(vertices, towards)
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        normal = towards - middle if self.normal == "sensor" else np.array(self.normal, dtype=np.float64)
        if not 0 < np.linalg.norm(normal) < np.inf:
            raise InputError(
                f"the normal of the wall is {self.normal}",
                where="frame.normal",
                allowed="a direction x, y, z that is not zero",
                remedy="write for example normal: [0, -1, 0], or leave the key out",
            )
        if np.dot(towards - middle, normal) < 0:
            raise InputError(
                f"the normal of the wall, {self.normal}, points away from the sensors",
                where="frame.normal",
                remedy="change the sign of the normal: the wall frame's z axis points towards the sensors",
            )
        return WallFrame.along(normal / np.linalg.norm(normal), vertices)


@dataclass(frozen=True)
class WallFrame:
    """The rigid transform from the world frame to the wall frame: x_wall = R (x_world - origin).

    R is `rotation`. The wall frame's z axis points out of the rock, so that x and y run along the wall. The world frame has the
    survey's coordinates, m. The origin is subtracted first, so that micrometres survive with UTM-sized coordinates.

    Attributes
    ----------
    rotation : (3, 3) array
        Rows are the wall frame's axes in world coordinates.
    origin : (3,) array
        Origin of the wall frame in world coordinates, m.
    """

    rotation: FloatArray
    origin: FloatArray

    @classmethod
    def fit(cls, vertices: FloatArray, towards: FloatArray) -> WallFrame:
        """Fit the wall frame to a wall: its z axis is the normal of the vertices' mean plane (least squares, by SVD).

        The z axis points towards the sensors, the y axis up the wall (on level ground, along the world's y). The origin lies
        in the mean plane, where x and y of this frame are the smallest of all vertices.

        Parameters
        ----------
        vertices : (n, 3) array
            Vertices of the wall, world frame, m.
        towards : (3,) array
            A point on the sensors' side of the wall, world frame, m. It fixes the sign of the normal.

        Raises
        ------
        InputError
            If the vertices do not span a plane.
        """
        centre = vertices.mean(axis=0)
        local = vertices - centre
        covariance = np.einsum("ni,nj->ij", local, local) / len(local)  # the SVD of 3 x 3: same axes, no (n, n) matrix
        axes, variances, _ = np.linalg.svd(covariance)
        if not variances[1] > 1e-12 * max(variances[0], 1e-300):
            raise InputError(
                "the vertices lie on one line, so there is no mean plane",
                where="wall mesh",
                remedy="give a mesh of a wall, whose vertices spread in two directions",
            )
        normal = axes[:, 2]
        return cls.along(normal if np.dot(np.asarray(towards) - centre, normal) >= 0 else -normal, vertices)

    @classmethod
    def along(cls, normal: FloatArray, vertices: FloatArray, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> WallFrame:
        """Make the wall frame with a given z axis, whose y axis points up the wall.

        The origin lies in the plane through the mean of the vertices, at their smallest x and y.

        Parameters
        ----------
        normal : (3,) array
            Unit vector along z, world frame.
        vertices : (n, 3) array
            Vertices of the wall, world frame, m.
        up : tuple of 3 floats
            The vertical, world frame.
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
        """Return the frame that equals the world frame, for data whose coordinates need no transformation."""
        return cls(np.eye(3), np.zeros(3))

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) homogeneous matrix that transforms world coordinates to the wall frame."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = -self.rotation @ self.origin
        return matrix

    def to_wall(self, points: FloatArray) -> FloatArray:
        """Transform points (..., 3) from the world to the wall frame, m."""
        return np.einsum("ij,...j->...i", self.rotation, points - self.origin)

    def to_world(self, points: FloatArray) -> FloatArray:
        """Transform points (..., 3) from the wall to the world frame, m."""
        return np.einsum("ji,...j->...i", self.rotation, points) + self.origin

    def direction_to_wall(self, directions: FloatArray) -> FloatArray:
        """Rotate direction vectors (..., 3) from the world to the wall frame, without the shift of origin that points need."""
        return np.einsum("ij,...j->...i", self.rotation, directions)
