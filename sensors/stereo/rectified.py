"""Resample a pair of pictures, with the nominal calibration, to grids whose rows are epipolar lines."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, CameraPair
from sensors.cameras.rectification import Rectification
from sensors.numerics.device import opaque, rotated

Picture = NDArray[np.float32]
Disparity = NDArray[np.float32]

LARGEST_STRETCH = 3
"""Largest ratio of a rectified picture's width to the camera's."""


@dataclass(frozen=True)
class RectifiedGrid:
    """Grids of cells on the two rectified images, in which the matcher searches along rows.

    Cell (i, j) of a grid, in row i and column j, is at u = step (j + first), v = step (i + top), px, where first is
    `left_first` or `right_first`.

    Attributes
    ----------
    pair : CameraPair
        The nominal cameras.
    geometry : Rectification
        Their rectification.
    step : int
        Frame px per cell.
    left_first, right_first, top : int
        Number of the first column of the left and of the right grid, and of their first row, cells.
    left_width, right_width, height : int
        Width of the left and of the right grid, and their common height, cells.
    """

    pair: CameraPair
    geometry: Rectification
    step: int
    left_first: int
    right_first: int
    top: int
    left_width: int
    right_width: int
    height: int

    @classmethod
    def cover(cls, pair: CameraPair, geometry: Rectification, step: int) -> RectifiedGrid:
        """Make the grids of cells that contain the whole width of both images, in the rows that both have.

        pair: the nominal cameras. geometry: their rectification. step: px of the frame per cell.

        Raises InputError if the cameras converge so much that rectification tears the images apart.
        """
        left_u, left_v = _outline(pair.left, geometry.left, geometry, geometry.u_left)
        right_u, right_v = _outline(pair.right, geometry.right, geometry, geometry.u_right)
        top, bottom = max(left_v.min(), right_v.min()) / step, min(left_v.max(), right_v.max()) / step
        rows = int(np.floor(bottom)) - int(np.ceil(top)) + 1
        left, right = ([int(np.floor(u.min() / step)), int(np.ceil(u.max() / step))] for u in (left_u, right_u))
        left_width, right_width = left[1] - left[0] + 1, right[1] - right[0] + 1
        if rows < 1 or max(left_width, right_width) > LARGEST_STRETCH * pair.left.width / step:
            raise InputError(
                "the cameras look into such different directions that their images cannot be rectified",
                where="cameras",
                remedy="correct `rotation` of the cameras so that both look at the wall, or set matcher: simulated",
            )
        return cls(pair, geometry, step, left[0], right[0], int(np.ceil(top)), left_width, right_width, rows)

    @property
    def disparity_offset(self) -> int:
        """Number of cells to add to a difference of grid columns, left minus right, to get a disparity.

        The two grids begin at different columns of the rectified images.
        """
        return self.left_first - self.right_first

    def left(self, image: NDArray[np.uint8]) -> Picture:
        """Resample the left picture to the left rectified grid: grey values (height, left_width), NaN outside the picture.

        image: grey values of the camera's picture, with one pixel per `step` px of the frame.
        """
        geometry = self.geometry
        return self._resampled(image, self.pair.left, geometry.left, geometry.u_left, self.left_first, self.left_width)

    def right(self, image: NDArray[np.uint8]) -> Picture:
        """Resample the right picture to the right rectified grid: grey values (height, right_width), NaN outside the picture.

        image: grey values of the camera's picture, with one pixel per `step` px of the frame.
        """
        geometry = self.geometry
        return self._resampled(image, self.pair.right, geometry.right, geometry.u_right, self.right_first, self.right_width)

    def cells(self, u: mi.Float64, v: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        """Convert rectified left pixels to positions in the left grid, at which to read disparities.

        u, v: (n,) columns and rows of the rectified image, px. Returns fractional columns and rows of the grid, (n,) each.
        """
        step, first, top = opaque(self.step, self.left_first, self.top)
        return u / step - first, v / step - top

    def _resampled(
        self, image: NDArray[np.uint8], camera: Camera, rotation: FloatArray, u_0: float, first: int, width: int
    ) -> Picture:
        """Interpolate (Lanczos) where each cell's ray meets the camera's image."""
        index, columns = dr.arange(mi.UInt32, self.height * width), dr.opaque(mi.UInt32, width)
        left, top, step, f, centre_u, centre_v = opaque(first, self.top, self.step, self.geometry.f, u_0, self.geometry.v)
        x = ((mi.Float64(index % columns) + left) * step - centre_u) / f
        y = ((mi.Float64(index // columns) + top) * step - centre_v) / f
        ray = rotated(rotation.T, mi.Array3f64(x, y, 1.0))
        u, v = camera.on_device().pixel(ray.x / ray.z, ray.y / ray.z)
        column, row = mi.Float32(u / step - 0.5), mi.Float32(v / step - 0.5)
        inside = (column >= 0) & (column <= image.shape[1] - 1) & (row >= 0) & (row <= image.shape[0] - 1)
        dr.eval(column, row, inside)
        maps = (array.numpy().reshape(self.height, width) for array in (column, row))
        picture = cv2.remap(image.astype(np.float32), *maps, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
        picture[~inside.numpy().reshape(picture.shape)] = np.nan
        return picture


def _outline(camera: Camera, rotation: FloatArray, geometry: Rectification, u_0: float) -> tuple[FloatArray, FloatArray]:
    """Return rectified pixels (u, v) of the frame's border.

    Raises InputError if a border ray is parallel to the rectified plane.
    """
    along = np.linspace(0, 1, 65)
    zero, one = np.zeros_like(along), np.ones_like(along)
    u = np.concatenate([along, along, zero, one]) * camera.width
    v = np.concatenate([zero, one, along, along]) * camera.height
    ray = rotation @ np.stack([*camera.tangents(u, v), np.ones_like(u)])
    if not (ray[2] > 0.05).all():
        raise InputError(
            "a camera looks along the base, the line between the two cameras",
            where="cameras",
            remedy="correct `rotation` (camera to world) so that both cameras look at the wall",
        )
    return geometry.f * ray[0] / ray[2] + u_0, geometry.f * ray[1] / ray[2] + geometry.v
