"""Where a scanner stood: one place for all points, or one for each file of points, in either face."""

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
_FEW_DIGITS, _ROUNDING = 0.005, 1e-9
"""How far a rotation matrix may be from orthonormal for want of digits, and how far it is left as it stands."""


class ScannerPose(Config):
    """Where the scanner stood, as surveyed."""

    position_m: Vector3 = Field(description="scanner's centre, world frame [m]")
    rotation: Matrix3 = Field(description="scanner to world; scanner z is the vertical axis")

    @field_validator("rotation")
    @classmethod
    def _orthonormal(cls, rotation: Matrix3) -> Matrix3:
        """A rotation of few digits becomes the nearest one (`mended` says so); one that is none is refused."""
        rows = np.array(rotation)
        if np.linalg.det(rows) <= 0 or np.abs(rows @ rows.T - np.eye(3)).max() > _FEW_DIGITS:
            return check_rotation(rotation)
        left, _, right = np.linalg.svd(rows)
        first, second, third = ((float(row[0]), float(row[1]), float(row[2])) for row in left @ right)
        nearest: Matrix3 = (first, second, third)
        return rotation if np.abs(rows - left @ right).max() < _ROUNDING else nearest


class ScannerScan(ScannerPose):
    """Where the scanner stood for one file of points. Scans of the same pose are of one set-up, which is registered once."""

    face: Face = Field(1, description="2: scanned in the second face, azimuth turned by pi, zenith angle 2 pi less")


@dataclass(frozen=True)
class Scanned:
    """One of several scans. pose: scanner to wall frame; set_up: number of those that were not moved between them, from 0."""

    pose: Pose
    face: Face
    set_up: int


def set_ups(scans: Sequence[ScannerScan]) -> list[int]:
    """The number of each scan's set-up: the same for the same pose."""
    known: list[tuple[Vector3, Matrix3]] = []
    numbers = []
    for scan in scans:
        pose = scan.position_m, scan.rotation
        if pose not in known:
            known.append(pose)
        numbers.append(known.index(pose))
    return numbers
