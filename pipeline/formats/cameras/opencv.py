"""Read and write calibrations in OpenCV's forms.

They are FileStorage (XML, YAML, JSON), and plain text of size, camera matrix and distortion.

OpenCV's distortion, with r2 = x^2 + y^2 (OpenCV 5 documentation, calib3d, detailed description), is

    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r2^2
    y' = y (same)                                                           + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r2^2
    u  = fx x' + cx,   v = fy y' + cy,   the centre of the top-left pixel at (0, 0)

Compared with Agisoft Metashape's model (ours), p1 and p2 are exchanged, fx = f + b1, fy = f, and cx, cy are relative to the
centre of the first pixel. Parameters that only one of the models has (b2 and k4 r^8 in ours; k4, k5, k6, s1..s4 and the tilts in
OpenCV's) must be zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.formats.files.atomic import writing
from scene.common.errors import InputError
from scene.common.regular_file import check_file, read_text
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import INTERIOR, Camera, Pose, checked_camera

DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""OpenCV's distortion coefficients in their order; a file may end after 4, 5, 8, 12 or 14 of them."""
_MOST_BYTES = 4_000_000
"""Largest size of a calibration file, which normally has some thousand bytes."""
_LENGTHS = (4, 5, 8, 12, 14)
"""Possible numbers of distortion coefficients."""
_SHARED = ("k1", "k2", "k3", "p1", "p2")
"""Coefficients that our camera model has too."""
_NAMES = {
    "matrix": ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M"),
    "distortion": ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D"),
    "width": ("image_width", "image_Width", "imageWidth", "width"),
    "height": ("image_height", "image_Height", "imageHeight", "height"),
}
"""Names of these values in files of different programs, OpenCV's own samples first."""


@dataclass(frozen=True)
class OpencvInterior:
    """Interior orientation of a camera in OpenCV's terms, px.

    fx and fy are focal lengths, cx and cy the principal point, k1 to k3 radial and p1, p2 tangential distortion. Unlike in
    OpenCV, cx and cy are relative to the frame's corner, as in COLMAP (OpenCV's plus 0.5).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @classmethod
    def of(cls, camera: Camera, where: str) -> OpencvInterior:
        """Convert the interior orientation of a camera to OpenCV's terms.

        where: name of the file to be written, for errors. Raises InputError if the camera has skew (b2) or k4, which OpenCV's
        model lacks.
        """
        for name, meaning in (("b2", "skew"), ("k4", "radial distortion, r^8")):
            if getattr(camera, name) != 0:
                raise InputError(
                    f"the parameter {name} = {getattr(camera, name):g} ({meaning}) has no counterpart in OpenCV's camera model",
                    where=where,
                    allowed=f"{name} = 0",
                    remedy="write a Metashape XML instead, or calibrate the camera again without this parameter",
                )
        principal = camera.width / 2 + camera.cx_px, camera.height / 2 + camera.cy_px
        radial = camera.k1, camera.k2
        return cls(camera.f_px + camera.b1, camera.f_px, *principal, *radial, camera.p2, camera.p1, camera.k3)

    def camera(self, width: float, height: float, where: str, pose: Pose | None = None) -> Camera:
        """Convert the interior orientation from OpenCV's terms to scarpsim's, and return it as a camera.

        Parameters
        ----------
        width, height : Size of the frame, px.
        where : Name of the file, for errors.
        pose : Pose in the world; None: at the origin.
        """
        interior = dict.fromkeys(INTERIOR, 0.0) | {"f_px": self.fy, "b1": self.fx - self.fy, "p1": self.p2, "p2": self.p1}
        interior |= {"cx_px": self.cx - width / 2, "cy_px": self.cy - height / 2, "k1": self.k1, "k2": self.k2, "k3": self.k3}
        return checked_camera(where, (width, height), interior, pose or (np.zeros(3), np.eye(3)))


def shared_distortion(values: dict[str, float], where: str) -> dict[str, float]:
    """Select the distortion coefficients of OpenCV's camera model that scarpsim's has too: k1, k2, k3, p1 and p2.

    values: coefficients by OpenCV's names. where: name of the file, for errors. Returns the selected ones by name. Raises
    InputError if another coefficient is not zero.
    """
    for name, value in values.items():
        if name not in _SHARED and value != 0:
            raise InputError(
                f"the distortion coefficient {name} = {value:g} has no counterpart in Metashape's camera model",
                where=where,
                allowed=f"{name} = 0",
                remedy="calibrate the camera again with k1, k2, k3, p1, p2 only",
            )
    return {name: value for name, value in values.items() if name in _SHARED}


def read_opencv(path: Path) -> Camera:
    """Read a camera's calibration that OpenCV wrote with FileStorage; its pose is the origin.

    Raises InputError if the file is not OpenCV's, is incomplete, or has a distortion coefficient that scarpsim's cameras lack.
    """
    check_file(path, most_bytes=_MOST_BYTES)
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        parts = {part: _first(storage, names) for part, names in _NAMES.items()}
        storage.release()
    except (cv2.error, SystemError):  # OpenCV 5 may return with an error set, for which Python raises SystemError
        raise InputError(
            "this is not a complete file of OpenCV's FileStorage",
            where=str(path),
            remedy="save the calibration again with cv2.FileStorage",
        ) from None
    for part, value in parts.items():
        if value is None:
            raise InputError(
                f"the file has no {part}",
                where=str(path),
                allowed=", ".join(_NAMES[part]),
                remedy=f"add the {part} under one of these names",
            )
    if np.ndim(parts["width"]) or np.ndim(parts["height"]):
        raise InputError(
            "width and height are not numbers",
            where=str(path),
            remedy="write image_width and image_height as whole numbers",
        )
    return _camera(
        (parts["width"], parts["height"]), np.asarray(parts["matrix"], float), np.ravel(parts["distortion"]), str(path)
    )


def write_opencv(path: Path, camera: Camera) -> None:
    """Write a camera's calibration, without the pose, as a file that OpenCV's FileStorage reads.

    path: its suffix gives the format (.xml, .yml, .yaml, .json). Raises InputError if OpenCV's model lacks a parameter that is
    not zero (b2, k4).
    """
    interior = OpencvInterior.of(camera, str(path))
    matrix = np.array([[interior.fx, 0.0, interior.cx - 0.5], [0.0, interior.fy, interior.cy - 0.5], [0.0, 0.0, 1.0]])
    with writing(path) as temporary:
        storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("camera_matrix", matrix)
        storage.write("distortion_coefficients", np.array([[getattr(interior, name) for name in DISTORTION[:5]]]))
        storage.release()


def read_opencv_text(path: Path) -> Camera:
    """Read a camera's calibration from a text file of numbers in OpenCV's terms and order; its pose is the origin.

    The numbers are width and height, px, the nine elements of the camera matrix row by row, px, and 4 to 14 distortion
    coefficients.
    """
    words = read_text(path, most_bytes=_MOST_BYTES).split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(
            f"the file contains something that is not a number ({error})",
            where=str(path),
            remedy="remove everything that is no number from the matrix and the distortion",
        ) from None
    if len(values) < 15:
        raise InputError(
            f"the file has only {len(values)} numbers",
            where=str(path),
            allowed="2 (size), 9 (camera matrix), 4 to 14 (distortion)",
            remedy="write the size, the camera matrix and the distortion, in this order",
        )
    return _camera((values[0], values[1]), values[2:11].reshape(3, 3), values[11:], str(path))


def _first(storage: Any, names: tuple[str, ...]) -> Any:
    """Return the first of the named nodes that exists, as a matrix or a number; None if there is none."""
    nodes = (storage.getNode(name) for name in names)
    node = next((node for node in nodes if not node.empty()), None)
    if node is None:
        return None
    return node.real() if node.isReal() or node.isInt() else node.mat()


def _camera(size: tuple[float, float], matrix: FloatArray, distortion: FloatArray, where: str) -> Camera:
    """Return the camera of a calibration."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or min(size) <= 0 or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise InputError(
            "the calibration has no camera matrix with positive fx, fy and frame size",
            where=where,
            remedy="calibrate the camera again, and save the matrix and the image size",
        )
    if matrix[0, 1] != 0:
        raise InputError(
            f"the camera matrix has the skew {matrix[0, 1]:g}",
            where=where,
            allowed="0, as in OpenCV's own model",
            remedy="calibrate the camera again without skew",
        )
    if len(distortion) not in _LENGTHS:
        raise InputError(
            f"the calibration has {len(distortion)} distortion coefficients",
            where=where,
            allowed="4, 5, 8, 12 or 14",
            remedy="save all coefficients that OpenCV returned",
        )
    coefficients = dict(zip(DISTORTION, distortion.astype(float).tolist(), strict=False))
    fx, fy, cx, cy = (float(value) for value in matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
    return OpencvInterior(fx, fy, cx + 0.5, cy + 0.5, **shared_distortion(coefficients, where)).camera(*size, where)
