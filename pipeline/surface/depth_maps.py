"""Represent depth maps with the camera of their own pixels; resample them to a pinhole camera and compute surface normals.

Both use inverse depth. For a pinhole camera and a plane n.P = d, with P = Z (x, y, 1), it is linear in the image,
    1/Z = (n_x x + n_y y + n_z) / d,
so that a plane is resampled exactly and its normal is the direction of the gradient (n_x, n_y, n_z).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera

_SNAP_PX = 1e-6
"""A pixel closer than this to a sample's centre takes the sample unchanged: a map without distortion keeps its values and
holes.
"""
_LEAST_SAMPLES = 6
"""Fewest samples in a window to which a plane is fitted; three would follow the noise."""


@dataclass(frozen=True)
class DepthMap:
    """Hold a depth map of a stereo pair, and the camera in which it is seen.

    Attributes
    ----------
    camera : Camera
        Camera whose image has the depth map's pixels, wall frame.
    depth : (h, w) array
        Depth of each pixel's surface point along the camera's axis, m; NaN without data.
    """

    camera: Camera
    depth: FloatArray

    def points(self) -> FloatArray:
        """Compute the surface point of each pixel of the depth map, (h, w, 3), wall frame, m; NaN without data."""
        x, y = self.camera.tangents(*_centres(self.camera))
        local = np.stack([x, y, np.ones_like(x)], axis=-1) * self.depth[..., None]
        return local @ self.camera.rotation.T + self.camera.position


def pinhole(source: DepthMap, depth_step_m: float) -> DepthMap:
    """Resample a depth map to a camera without lens distortion, with the same focal length and principal point.

    Inverse depth is interpolated bilinearly. A pixel has no data if one of the four samples around it has none.

    Parameters
    ----------
    source : DepthMap
        The depth map, whose camera may have lens distortion.
    depth_step_m : float
        Where the four samples around a pixel differ by more than this, m, the nearest one is used instead of a mean.
    """
    plain = replace(source.camera, b1=0.0, b2=0.0, k1=0.0, k2=0.0, k3=0.0, k4=0.0, p1=0.0, p2=0.0)
    u, v = source.camera.pixel(*plain.tangents(*_centres(plain)))
    column, row = (_snapped(place - 0.5) for place in (u, v))
    height, width = source.depth.shape
    inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    column, row = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
    depth = _interpolated(source.depth, column, row, depth_step_m)
    return DepthMap(plain, np.where(inside, depth, np.nan))


def normals(source: DepthMap, radius: int) -> NDArray[np.float64]:
    """Compute the surface normals of a depth map, by fitting a plane in a window around each pixel.

    Parameters
    ----------
    source : DepthMap
        Depth map of a camera without lens distortion (see `pinhole`).
    radius : int
        The windows have 2 radius + 1 pixels a side.

    Returns
    -------
    (h, w, 3) array
        Unit normals towards the camera, in its frame; NaN where there is no depth, or fewer than six samples in the window.
    """
    valid = np.isfinite(source.depth)
    inverse = np.where(valid, 1.0 / np.where(valid, source.depth, 1.0), 0.0)
    mean_j, mean_i, spread, count = _moments(valid.astype(float), radius)
    mean_w, covariance_j, covariance_i = _covariances(valid, inverse, count, mean_j, mean_i, radius)
    (jj, ii, ji), camera = spread, source.camera
    u, v = _centres(camera)
    with np.errstate(invalid="ignore", divide="ignore"):
        determinant = jj * ii - ji * ji
        a = camera.f_px * (ii * covariance_j - ji * covariance_i) / determinant  # inverse depth per x
        b = camera.f_px * (jj * covariance_i - ji * covariance_j) / determinant  # per y
        x, y = camera.tangents(u + mean_j, v + mean_i)
        normal = -np.stack([a, b, mean_w - a * x - b * y], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    usable = valid & (count >= _LEAST_SAMPLES) & (determinant > 1e-6)
    return np.where(usable[..., None], normal, np.nan)


def _centres(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return the pixel coordinates (u, v) of all pixel centres, (h, w) each."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return u, v


def _snapped(place: FloatArray) -> FloatArray:
    """Round positions that lie very close to a whole number."""
    whole = np.round(place)
    return np.where(np.abs(place - whole) < _SNAP_PX, whole, place)


def _interpolated(depth: FloatArray, column: FloatArray, row: FloatArray, step_m: float) -> FloatArray:
    """Interpolate inverse depth bilinearly; at a depth step take the nearest sample."""
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    right, below = np.ceil(column).astype(int), np.ceil(row).astype(int)
    across, down = column - left, row - top
    corners = np.stack([depth[top, left], depth[top, right], depth[below, left], depth[below, right]])
    weights = np.stack([(1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down])
    smooth = 1.0 / np.sum(weights / corners, axis=0)
    nearest = depth[np.round(row).astype(int), np.round(column).astype(int)]
    return np.where(np.ptp(corners, axis=0) > step_m, nearest, smooth)


def _moments(valid: FloatArray, radius: int) -> tuple[FloatArray, FloatArray, tuple[FloatArray, ...], FloatArray]:
    """Compute the moments of the samples' offsets from the middle of each window.

    Returns mean column and row offset, their (co)variances (columns, rows, mixed), and the number of samples.
    """
    count = _window(valid, radius)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_j, mean_i = _window(valid, radius, 1, 0) / count, _window(valid, radius, 0, 1) / count
        jj, ii = _window(valid, radius, 2, 0) / count - mean_j**2, _window(valid, radius, 0, 2) / count - mean_i**2
        ji = _window(valid, radius, 1, 1) / count - mean_j * mean_i
    return mean_j, mean_i, (jj, ii, ji), count


def _covariances(
    valid: NDArray[np.bool_], inverse: FloatArray, count: FloatArray, mean_j: FloatArray, mean_i: FloatArray, radius: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean inverse depth in each window and its covariances with the column and the row offset."""
    middle = float(inverse[valid].mean()) if valid.any() else 0.0  # subtracted first, against cancellation
    rest = np.where(valid, inverse - middle, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = _window(rest, radius) / count
        covariance_j = _window(rest, radius, 1, 0) / count - mean * mean_j
        covariance_i = _window(rest, radius, 0, 1) / count - mean * mean_i
    return mean + middle, covariance_j, covariance_i


def _window(values: FloatArray, radius: int, power_j: int = 0, power_i: int = 0) -> FloatArray:
    """Sum values times j^power_j i^power_i over each pixel's window, with j and i the column and row offset from the pixel."""
    from scipy import ndimage

    offset = np.arange(-radius, radius + 1, dtype=float)
    along_rows: FloatArray = ndimage.correlate1d(values, offset**power_j, axis=1, mode="constant")
    sums: FloatArray = ndimage.correlate1d(along_rows, offset**power_i, axis=0, mode="constant")
    return sums
