"""Place a sensor that is described by its distance from the wall instead of by coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from scene.common.config import Config
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import Camera, CameraPair, Matrix3, Vector3, axis_rotation, check_rotation

_FARTHEST_M = 1e5
"""Largest distance of a sensor, m."""
Height = Annotated[float, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
VERTICAL = np.array([0.0, 0.0, 1.0])
"""Direction up, world frame."""


@dataclass(frozen=True)
class Target:
    """The wall as a sensor's target, from which the sensor's place is found: a mesh in the world frame.

    Its faces are counter-clockwise seen from outside.
    """

    mesh: TriangleMesh

    @cached_property
    def centre(self) -> FloatArray:
        """(3,) centre of the wall's bounding box, world frame, m, at which sensors look."""
        return self.mesh.bounds.mean(axis=0)

    @cached_property
    def outward(self) -> FloatArray:
        """(3,) horizontal unit vector, world frame, from the wall towards the side that its faces look to, where sensors stand.

        Raises InputError if the mesh faces straight up or down or is closed, so that it has no front.
        """
        area = self.mesh.area_normals()
        total, horizontal = np.linalg.norm(area, axis=1).sum(), area.sum(axis=0) * [1.0, 1.0, 0.0]
        if np.linalg.norm(horizontal) < 1e-3 * total:
            raise InputError(
                "the wall has no front (it is closed or horizontal)", where="wall", remedy="give the sensor's position_m"
            )
        return horizontal / np.linalg.norm(horizontal)

    def stand(self, distance_m: float, height_m: float | None) -> FloatArray:
        """Return the place (3,), world frame, m, at `distance_m` horizontally in front of the wall's centre, for a sensor.

        It lies `height_m` above the wall's lowest point, or level with the wall's centre if that is None.
        """
        position = self.centre + distance_m * self.outward
        return position if height_m is None else np.append(position[:2], self.mesh.bounds[0, 2] + height_m)


class RigConfig(Config):
    """A stereo pair of equal cameras in front of the wall, both looking at its centre (by default Glendale's geometry)."""

    distance_m: float = Field(105.0, gt=0, le=_FARTHEST_M, description="horizontal distance from the wall's centre [m]")
    base_m: float = Field(28.0, gt=0, description="distance between the cameras [m]")
    height_m: Height | None = Field(None, description="height above the wall's toe, none: level with the wall's centre [m]")
    width: int = Field(7360, gt=0, le=100_000, description="frame width [px]")
    height: int = Field(4912, gt=0, le=100_000, description="frame height [px]")
    sensor_width_m: float = Field(0.0359, gt=0, le=0.5, description="width of the image sensor [m]")
    focal_length_m: float = Field(0.050, gt=0, le=3.0, description="principal distance [m]")
    k1: float = Field(0.0, description="radial distortion, r^2")
    k2: float = Field(0.0, description="radial distortion, r^4")

    def place(self, target: Target) -> CameraPair:
        """Return the pair of cameras in front of a wall, world frame; the left one is on the left as seen from the cameras.

        target: the wall.
        """
        middle = target.stand(self.distance_m, self.height_m)
        shift = self.base_m / 2 * np.cross(-target.outward, VERTICAL)
        return CameraPair(self._camera(middle - shift, target.centre), self._camera(middle + shift, target.centre))

    def _camera(self, position: FloatArray, aim: FloatArray) -> Camera:
        """Make one camera at `position` that looks at `aim`."""
        f_px = self.focal_length_m / self.sensor_width_m * self.width
        distortion = {"k1": self.k1, "k2": self.k2, "k3": 0.0, "k4": 0.0, "p1": 0.0, "p2": 0.0}
        camera = Camera(
            self.width, self.height, f_px, 0.0, 0.0, 0.0, 0.0, **distortion, position=position, rotation=look_at(position, aim)
        )
        camera.check_invertible()
        return camera


def look_at(position: FloatArray, aim: FloatArray) -> FloatArray:
    """Return the rotation (3, 3), camera to world, of a level camera at `position` whose axis passes through the point `aim`.

    Both are (3,), world frame, m.
    """
    forward = (aim - position) / np.linalg.norm(aim - position)
    right = np.cross(forward, VERTICAL)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


class PoseSigma(Config):
    """How well a station's pose is known; the difference between real and surveyed pose is drawn for each observation.

    A station is the place where the scanner stands; its pose is position and rotation.
    """

    position_m: float = Field(0.0, ge=0, description="standard deviation of each coordinate [m]")
    rotation_rad: float = Field(0.0, ge=0, le=0.1, description="standard deviation of the rotation about each axis [rad]")

    def displaced(self, position: FloatArray, rotation: FloatArray, random: KeyedRandom) -> tuple[FloatArray, FloatArray]:
        """Draw the real pose of a scanner at random about its surveyed one.

        Parameters
        ----------
        position : (3,) array
            Surveyed position, m.
        rotation : (3, 3) array
            Surveyed rotation, scanner to the frame of `position`.
        random : KeyedRandom
            Source of random numbers.

        Returns
        -------
        (3,) array and (3, 3) array
            Real position, m, and real rotation.
        """
        if self.position_m == self.rotation_rad == 0:
            return position, rotation
        shift, turn = random.generator().standard_normal((2, 3)) * [[self.position_m], [self.rotation_rad]]
        x, y, z = (axis_rotation(axis, float(angle)) for axis, angle in enumerate(turn))
        return position + shift, z @ y @ x @ rotation


EXACT_POSE = PoseSigma()


class StationConfig(Config):
    """Where the laser scanner stands: at given coordinates, or at a distance in front of the wall's centre.

    `pose_sigma` says how well position and rotation are known; by default they are exact.
    """

    position_m: Vector3 | None = Field(None, description="scanner's centre, world frame; none: from distance_m and height_m [m]")
    distance_m: float = Field(
        105.0, gt=0, le=_FARTHEST_M, description="horizontal distance from the wall's centre, where no position_m is given [m]"
    )
    height_m: Height = Field(1.6, description="height above the wall's toe, where no position_m is given [m]")
    rotation: Matrix3 | None = Field(None, description="scanner to world; none: levelled, azimuth 0 towards the wall's centre")
    pose_sigma: PoseSigma = EXACT_POSE

    @field_validator("rotation")
    @classmethod
    def _orthonormal(cls, rotation: Matrix3 | None) -> Matrix3 | None:
        return None if rotation is None else check_rotation(rotation)

    def place(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Return where the scanner stands before a wall: position (3,), m, and rotation (3, 3), scanner to world frame.

        target: the wall.
        """
        position = np.array(self.position_m) if self.position_m else target.stand(self.distance_m, self.height_m)
        if self.rotation:
            return position, np.array(self.rotation)
        forward = (target.centre - position) * [1.0, 1.0, 0.0]
        if np.linalg.norm(forward) < 1e-6:
            forward = -target.outward
        forward /= np.linalg.norm(forward)
        return position, np.stack([forward, np.cross(VERTICAL, forward), VERTICAL], axis=1)


def check_in_front(scene: RayCaster, position: FloatArray, where: str) -> None:
    """Check that a sensor sees the rock from outside: raise InputError if it sees it mostly from inside or from behind.

    This is decided from the sides of the faces that lines of sight hit first. position: (3,), in the scene's frame, m. where:
    the config key in the error message.
    """
    _, from_behind = scene.sides_seen(position)
    if 2 * int(from_behind.sum()) > len(from_behind):
        share = f"{100 * from_behind.mean():.0f} %"  # rounded, as single rays along edges differ between processors
        raise InputError(
            f"{share} of the lines of sight meet the rock from behind: the sensor stands in or behind it",
            where=where,
            remedy="move the sensor in front of the wall; if a mesh's triangles are wound the wrong way, set wall.flipped: true",
        )
