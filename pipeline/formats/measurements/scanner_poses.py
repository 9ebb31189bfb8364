"""The scanner's pose in measurement.yaml: one for all points, or one for each file of points, in either face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from scene.common.config import Config
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Matrix3, Vector3, check_rotation

Pose = tuple[FloatArray, FloatArray]
"""Position (3,) m and rotation (3, 3) of a sensor."""
Face = Literal[1, 2]
"""1, or 2 for the second face of the instrument."""
_FEW_DIGITS, _ROUNDING = 0.005, 1e-9
"""Largest deviation of a rotation matrix from orthonormal that missing digits explain, and the deviation up to which it
is kept.
"""


class ScannerPose(Config):
    """Surveyed position and orientation of a laser scanner in measurement.yaml."""

    position_m: Vector3 = Field(description="scanner's centre, world frame [m]")
    rotation: Matrix3 = Field(description="scanner to world; scanner z is the vertical axis")

    @field_validator("rotation")
    @classmethod
    def _orthonormal(cls, rotation: Matrix3) -> Matrix3:
        """Replace a rotation with few digits by the nearest one, and refuse a matrix that is not a rotation."""
        rows = np.array(rotation)
        if np.linalg.det(rows) <= 0 or np.abs(rows @ rows.T - np.eye(3)).max() > _FEW_DIGITS:
            return check_rotation(rotation)
        left, _, right = np.linalg.svd(rows)
        first, second, third = ((float(row[0]), float(row[1]), float(row[2])) for row in left @ right)
        nearest: Matrix3 = (first, second, third)
        return rotation if np.abs(rows - left @ right).max() < _ROUNDING else nearest


class ScannerScan(ScannerPose):
    """Pose of the laser scanner for one file of points in measurement.yaml, and the face in which it scanned.

    Scans with the same pose belong to one set-up, which is registered once.
    """

    face: Face = Field(
        1,
        description="2: scanned in the second face, with the azimuth turned by pi and the zenith angle reversed (2 pi minus it)",
    )


@dataclass(frozen=True)
class Scanned:
    """Pose and face of one of several laser scans in a measurement.

    Attributes
    ----------
    pose : Scanner to wall frame.
    face : Face of the instrument: 1, or 2 if the azimuth is turned by pi and the zenith angle reversed.
    set_up : Number of its set-up, from 0; scans between which the scanner was not moved share one.
    """

    pose: Pose
    face: Face
    set_up: int


def set_ups(scans: Sequence[ScannerScan]) -> list[int]:
    """Return the number, from 0, of the set-up in which each scan was made; scans with the same pose share one."""
    known: list[tuple[Vector3, Matrix3]] = []
    numbers = []
    for scan in scans:
        pose = scan.position_m, scan.rotation
        if pose not in known:
            known.append(pose)
        numbers.append(known.index(pose))
    return numbers
