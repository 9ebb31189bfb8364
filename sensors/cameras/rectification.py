"""Rectify a calibrated pair of cameras epipolarly, with OpenCV.

Rows are aligned as by Fusiello, and the rotation is split between the cameras as by Bouguet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, CameraPair


@dataclass(frozen=True)
class Rectification:
    """The rectified image pair: two virtual cameras, one for each real one, whose rows are epipolar lines.

    A point (x, y, z) in the rectified left frame has the column u_l = f x / z + u_left and the row f y / z + v in the left
    image, and the column u_r in the right image. Its disparity is d = u_l - u_r, so that z = f base_m / (d - (u_left -
    u_right)).

    Attributes
    ----------
    left, right : (3, 3) arrays
        Rotation from each camera's frame to the rectified frame.
    f : float
        Principal distance, px.
    u_left, u_right, v : float
        Columns of the two principal points, and their common row, px.
    base_m : float
        Distance between the perspective centres, m.
    """

    left: FloatArray
    right: FloatArray
    f: float
    u_left: float
    u_right: float
    v: float
    base_m: float

    @property
    def offset(self) -> float:
        """Disparity of a point at infinity, px: the difference of the principal points, left minus right."""
        return self.u_left - self.u_right


def rectify(pair: CameraPair) -> Rectification:
    """Rectify a pair of cameras: find two virtual cameras whose rows are epipolar lines, so that disparities give depths.

    Both cameras are in one frame. Lens distortion is not part of this; `Camera.tangents` removes it. Raises InputError if the
    cameras are exchanged, stand at the same place, or above each other.
    """
    left, right = pair.left, pair.right
    rotation = right.rotation.T @ left.rotation
    base = right.rotation.T @ (left.position - right.position)
    if pair.base_m < 1e-6:
        raise InputError(
            "both cameras stand at the same place", where="cameras", remedy="give left and right different values of position_m"
        )
    size = (left.width, left.height)
    rotations_and_projections = cv2.stereoRectify(
        _matrix(left), np.zeros(5), _matrix(right), np.zeros(5), size, rotation, base.reshape(3, 1), flags=0, alpha=-1
    )
    r_left, r_right, p_left, p_right = rotations_and_projections[:4]
    if abs(p_right[1, 3]) > abs(p_right[0, 3]):
        raise InputError(
            "the base, the line between the cameras, runs along the images' columns instead of their rows",
            where="cameras",
            remedy="turn both cameras by 90 degrees about their viewing axes",
        )
    base_m = -p_right[0, 3] / p_left[0, 0]
    if base_m < 0:
        raise InputError(
            "the left camera stands to the right of the right one",
            where="cameras",
            remedy="exchange the cameras left and right in the config",
        )
    return Rectification(r_left, r_right, p_left[0, 0], p_left[0, 2], p_right[0, 2], p_left[1, 2], base_m)


def _matrix(camera: Camera) -> FloatArray:
    """Return OpenCV's camera matrix (3, 3), where pixel centres are at integers."""
    matrix: Any = np.diag([camera.f_px, camera.f_px, 1.0])
    matrix[0, 2] = camera.width / 2 + camera.cx_px - 0.5
    matrix[1, 2] = camera.height / 2 + camera.cy_px - 0.5
    return matrix
