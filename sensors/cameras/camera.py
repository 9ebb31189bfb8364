"""Define the frame camera (Agisoft Metashape's model and its exact inverse) and the pair of cameras.

With (X, Y, Z) in the camera's frame (x right, y down, z forward), x = X/Z, y = Y/Z, r2 = x^2 + y^2:
    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + p1 (r2 + 2 x^2) + 2 p2 x y
    y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) + p2 (r2 + 2 y^2) + 2 p1 x y
    u  = width/2 + cx + x' f + x' b1 + y' b2,   v = height/2 + cy + y' f
(Metashape user manual, appendix D). The centre of the top-left pixel is (0.5, 0.5). Differences from OpenCV: p1 and p2 are
exchanged, pixel centres differ by 0.5, and k4 and b2 have no counterpart.

The equations use only arithmetic, so they work for NumPy arrays and Dr.Jit arrays alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from scene.common.backend import dr, mi
from scene.common.config import Config, parse
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

_FARTHEST_M = 1e8
"""No coordinate system of a survey extends farther, m."""
Coordinate = Annotated[float, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
Pixels = Annotated[float, Field(ge=-100_000, le=100_000)]
Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Pose = tuple[FloatArray, FloatArray]
"""Position (3,), m, and rotation (3, 3) from the camera to the frame of the position."""
Side = Literal["left", "right", "both"]
"""One of the cameras of a pair, or both."""

NEWTON_STEPS = 6
"""Newton steps of the inverse distortion. They converge quadratically: four reach 1e-15 for a lens with 10 % distortion."""

INTERIOR = ("f_px", "cx_px", "cy_px", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
"""The interior orientation: Metashape's names, with units (b1, b2 in px)."""


class CameraConfig(Config):
    """One camera: interior orientation in Metashape's model, exterior orientation in the world frame.

    The interior orientation is the principal distance, the principal point and the distortion; the exterior orientation is the
    position and the direction of view.
    """

    width: int = Field(gt=0, le=100_000, description="frame width [px]")
    height: int = Field(gt=0, le=100_000, description="frame height [px]")
    f_px: float = Field(gt=0, le=1e7, description="principal distance [px]")
    cx_px: Pixels = Field(0.0, description="principal point, from the frame's centre [px]")
    cy_px: Pixels = Field(0.0, description="principal point, from the frame's centre [px]")
    b1: Pixels = Field(0.0, description="affinity [px]")
    b2: Pixels = Field(0.0, description="skew [px]")
    k1: float = Field(0.0, description="radial distortion, r^2")
    k2: float = Field(0.0, description="radial distortion, r^4")
    k3: float = Field(0.0, description="radial distortion, r^6")
    k4: float = Field(0.0, description="radial distortion, r^8")
    p1: float = Field(0.0, description="tangential distortion, Metashape's order")
    p2: float = Field(0.0, description="tangential distortion, Metashape's order")
    position_m: Vector3 = Field(description="perspective centre, world frame [m]")
    rotation: Matrix3 = Field(description="camera to world (camera x right, y down, z forward)")

    @field_validator("rotation")
    @classmethod
    def _orthonormal(cls, rotation: Matrix3) -> Matrix3:
        return check_rotation(rotation)

    def camera(self) -> Camera:
        """Return the configured camera for computations, world frame.

        Raises InputError if the lens distortion cannot be inverted over the whole image.
        """
        interior = {name: getattr(self, name) for name in INTERIOR}
        position, rotation = np.array(self.position_m), np.array(self.rotation)
        camera = Camera(self.width, self.height, **interior, position=position, rotation=rotation)
        camera.check_invertible()
        return camera


def checked_camera(where: str, size: tuple[float, float], interior: Mapping[str, float], pose: Pose) -> Camera:
    """Make a camera from the values in another program's file, after checking them against the limits of `CameraConfig`.

    Parameters
    ----------
    where : str
        Name of the file in error messages.
    size : (float, float)
        Width and height, px.
    interior : mapping
        Interior orientation by name (f_px, cx_px, k1 and so on, as in `CameraConfig`); missing ones are 0.
    pose : Pose
        Exterior orientation, world frame: position (3,), m, and rotation (3, 3), camera to world.

    Raises
    ------
    InputError
        If a value is out of bounds or the distortion cannot be inverted.
    """
    position, rotation = (np.asarray(part, dtype=float).tolist() for part in pose)
    values = {"width": size[0], "height": size[1], **interior, "position_m": position, "rotation": rotation}
    return parse(CameraConfig, values, where).camera()


def check_rotation(rotation: Matrix3) -> Matrix3:
    """Check a rotation matrix from a config, and return it unchanged.

    Raises ValueError if it is not orthonormal (to 1e-6) with determinant +1.
    """
    matrix = np.array(rotation)
    if not (np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6) and np.linalg.det(matrix) > 0):
        raise ValueError("is not a rotation matrix (rows must be orthonormal, determinant +1)")
    return rotation


@dataclass(frozen=True)
class Camera:
    """A camera with interior orientation (Metashape's model, px) and pose.

    On the ray-tracing device (`on_device`) the interior orientation holds Dr.Jit scalars instead of floats, so that one
    compiled kernel serves all values.

    Attributes
    ----------
    width, height : int
        Size of the frame, px.
    f_px, cx_px, cy_px, b1, b2, k1, k2, k3, k4, p1, p2
        Interior orientation in Metashape's model: principal distance, principal point from the frame's centre, affinity and
        skew (all px), and radial and tangential distortion.
    position : (3,) array
        Perspective centre, m.
    rotation : (3, 3) array
        Rotation from the camera's frame (x right, y down, z forward) to the frame of `position`.
    """

    width: int
    height: int
    f_px: Any
    cx_px: Any
    cy_px: Any
    b1: Any
    b2: Any
    k1: Any
    k2: Any
    k3: Any
    k4: Any
    p1: Any
    p2: Any
    position: FloatArray
    rotation: FloatArray

    def distort(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Add the lens distortion to image coordinates: convert ideal x = X/Z, y = Y/Z in the camera's frame to distorted ones.

        Arrays of any shape, without unit.
        """
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
        return (
            x * radial + self.p1 * (r2 + 2 * x * x) + 2 * self.p2 * x * y,
            y * radial + self.p2 * (r2 + 2 * y * y) + 2 * self.p1 * x * y,
        )

    def undistort(self, xd: Any, yd: Any) -> tuple[Any, Any]:
        """Remove the lens distortion from image coordinates: convert distorted xd, yd to ideal X/Z, Y/Z in the camera's frame.

        Arrays of any shape, without unit. Newton's method with the analytic Jacobian is used.
        """
        x, y = xd, yd
        for _ in range(NEWTON_STEPS):
            fx, fy = self.distort(x, y)
            jxx, jxy, jyy = self._jacobian(x, y)
            ex, ey, determinant = fx - xd, fy - yd, jxx * jyy - jxy * jxy
            x, y = x - (jyy * ex - jxy * ey) / determinant, y - (jxx * ey - jxy * ex) / determinant
        return x, y

    def _jacobian(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the elements xx, xy (= yx) and yy of the Jacobian of `distort`, which is symmetric."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
        slope = 2 * (self.k1 + r2 * (2 * self.k2 + r2 * (3 * self.k3 + r2 * 4 * self.k4)))  # d radial = slope (x dx + y dy)
        return (
            radial + slope * x * x + 6 * self.p1 * x + 2 * self.p2 * y,
            slope * x * y + 2 * self.p1 * y + 2 * self.p2 * x,
            radial + slope * y * y + 6 * self.p2 * y + 2 * self.p1 * x,
        )

    def pixel(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Project points into the image: convert ideal image coordinates x = X/Z, y = Y/Z to pixels (u, v), with distortion.

        X, Y, Z are coordinates in the camera's frame (x right, y down, z forward). Arrays of any shape; u is the column and v
        the row, px.
        """
        xd, yd = self.distort(x, y)
        u = self.width / 2 + self.cx_px + xd * self.f_px + xd * self.b1 + yd * self.b2
        return u, self.height / 2 + self.cy_px + yd * self.f_px

    def tangents(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Convert pixels to rays: from column u and row v, px, to ideal image coordinates (X/Z, Y/Z in the camera's frame).

        Arrays of any shape. This is the exact inverse of `pixel`.
        """
        yd = (v - self.height / 2 - self.cy_px) / self.f_px
        xd = (u - self.width / 2 - self.cx_px - yd * self.b2) / (self.f_px + self.b1)
        return self.undistort(xd, yd)

    def on_device(self) -> Camera:
        """Return the same camera for use on the ray-tracing device: its interior orientation is held in Dr.Jit scalars."""
        return replace(self, **{name: dr.opaque(mi.Float64, float(getattr(self, name))) for name in INTERIOR})

    def in_wall_frame(self, frame: WallFrame) -> Camera:
        """Return the same camera with its pose transformed from the world to the wall frame, in which rays are traced."""
        return replace(self, position=frame.to_wall(self.position), rotation=frame.rotation @ self.rotation)

    def reduced(self, step: float, width: int, height: int, corner: tuple[float, float] = (0.0, 0.0)) -> Camera:
        """Return the camera of a reduced or cropped image.

        Parameters
        ----------
        step : float
            Side of the new pixels in px of this camera's frame.
        width, height : int
            Size of the new image, px.
        corner : (float, float)
            Where the new image starts in this camera's frame, px.
        """
        cx = (self.width / 2 + self.cx_px - corner[0]) / step - width / 2
        cy = (self.height / 2 + self.cy_px - corner[1]) / step - height / 2
        scaled = {name: getattr(self, name) / step for name in ("f_px", "b1", "b2")}
        return replace(self, width=width, height=height, cx_px=cx, cy_px=cy, **scaled)

    def turned(self) -> Camera:
        """Return the same camera with its image read upside down, which exchanges left and right.

        Its pixel (u, v) is this camera's pixel (width - u, height - v).
        """
        mirrored = {name: -getattr(self, name) for name in ("cx_px", "cy_px", "p1", "p2")}
        return replace(self, rotation=self.rotation * [-1.0, -1.0, 1.0], **mirrored)

    def check_invertible(self) -> None:
        """Check that each pixel has one ray: raise InputError if the lens distortion folds the image within the frame.

        Then `tangents` (from pixels to rays) would not invert `pixel` (from rays to pixels).
        """
        u, v = np.meshgrid(np.linspace(0, self.width, 33), np.linspace(0, self.height, 33))
        with np.errstate(all="ignore"):
            x, y = self.tangents(u, v)
            folded = self._jacobian(x, y)
            back_u, back_v = self.pixel(x, y)
            error = np.hypot(back_u - u, back_v - v)
        if not (np.isfinite(error).all() and error.max() < 1e-6 and (folded[0] * folded[2] > folded[1] ** 2).all()):
            raise InputError(
                "the lens distortion folds the image: two directions fall on one pixel, so it cannot be inverted",
                where="camera calibration",
                remedy="correct k1 to k4, p1 and p2; as in Metashape they apply to tangents of angles, not to pixels",
            )


@dataclass(frozen=True)
class CameraPair:
    """The left and the right camera of a fixed stereo pair, in the same frame."""

    left: Camera
    right: Camera

    def in_wall_frame(self, frame: WallFrame) -> CameraPair:
        """Return the pair with its poses transformed from the world to the wall frame, in which rays are traced."""
        return CameraPair(self.left.in_wall_frame(frame), self.right.in_wall_frame(frame))

    def exchanged(self) -> CameraPair:
        """Return the pair with both cameras upside down, so that the right camera becomes the left one.

        With it, a depth map of the right image is made like one of the left image.
        """
        return CameraPair(self.right.turned(), self.left.turned())

    @property
    def base_m(self) -> float:
        """Base of the stereo pair: the distance between the perspective centres of its cameras, m."""
        return float(np.linalg.norm(self.right.position - self.left.position))

    def changed(self, side: Side, **added: float) -> CameraPair:
        """Return the pair with an error of interior orientation, such as of the principal distance.

        side: the camera, "left", "right" or "both". added: what to add to interior parameters, by name, such as f_px=2.0.
        """
        return self._each(
            side, lambda camera: replace(camera, **{key: getattr(camera, key) + value for key, value in added.items()})
        )

    def rotated(self, side: Side, axis: int, angle_rad: float) -> CameraPair:
        """Return the pair with an error of orientation: cameras rotated about an own axis, right-handed.

        Parameters
        ----------
        side : str
            The camera, "left", "right" or "both".
        axis : int
            Axis of the camera's frame: x (0, right), y (1, down) or z (2, forward).
        angle_rad : float
            Angle, rad.
        """
        turn = axis_rotation(axis, angle_rad)
        return self._each(side, lambda camera: replace(camera, rotation=camera.rotation @ turn))

    def shifted(self, side: Side, shift_m: FloatArray) -> CameraPair:
        """Return the pair with an error of the perspective centres.

        side: the camera, "left", "right" or "both". shift_m: (3,) displacement, m, along the axes of the pair's frame.
        """
        return self._each(side, lambda camera: replace(camera, position=camera.position + shift_m))

    def _each(self, side: Side, change: Any) -> CameraPair:
        """Apply `change` to one camera or to both."""
        sides = [field.name for field in fields(self)] if side == "both" else [side]
        return replace(self, **{name: change(getattr(self, name)) for name in sides})


def axis_rotation(axis: int, angle_rad: float) -> FloatArray:
    """Return the right-handed rotation matrix (3, 3) about coordinate axis x (0), y (1) or z (2), by an angle in rad."""
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    matrix = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix[first, first] = matrix[second, second] = cosine
    matrix[second, first], matrix[first, second] = sine, -sine
    return matrix
