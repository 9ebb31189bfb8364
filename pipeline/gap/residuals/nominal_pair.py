"""Project points and pixels with the nominal stereo pair: rays of pixels, disparities in its rectification, and the real pair.

The nominal pair has the calibration that the measurement states; the real pair has the camera effects of the model too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.gap.residuals.residuals import BoolArray, Rows, select_rows
from scene.common.backend import dr, mi
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from scene.ray_casting.upload import on_device, vectors_on_device
from sensors.cameras.camera import INTERIOR, Camera, CameraPair
from sensors.cameras.rectification import Rectification, rectify
from sensors.effects.base import Effect, Stage
from sensors.numerics.device import rotated, vector
from sensors.stereo.stereo_pair import rectified_pixel, rectified_tangents, row_tangent

_HIDDEN_SHARE = 2e-4
"""A point is hidden if another surface lies in front of it by more than this share of its distance."""


@dataclass(frozen=True)
class PixelGeometry:
    """Geometry of n pixels that a stereo pair matched: the quantities on which errors of disparities depend.

    The reference is the surface with which the measurement is compared.

    Attributes
    ----------
    u, v : (n,) column and row in the left image, px.
    v_right : (n,) row in the right image, px.
    disparity : (n,) disparity of the reference, px.
    found : (n,) measured disparity, px.
    point, normal : (n, 3) point of the reference that the pixel sees, m, and its unit normal, wall frame.
    radius : (n,) distance from the centre of the left image, px.
    tangent : (n,) vertical slope of the line of sight in the rectified left image: (row - principal row) / focal length in px.
    infinity : (n,) disparity of a point at infinity, px.
    shaped : (n,) change of the disparity by edge fattening, smoothing and filled occlusions of the sensor model, px; 0 without.
    along_row, along_column : (n,) change of the reference's disparity along the row and along the column of the left image,
        between neighbouring cells of the matcher's raster, px per px; None if not computed.
    """

    u: FloatArray
    v: FloatArray
    v_right: FloatArray
    disparity: FloatArray
    found: FloatArray
    point: FloatArray
    normal: FloatArray
    radius: FloatArray
    tangent: FloatArray
    infinity: FloatArray
    shaped: FloatArray
    along_row: FloatArray | None = None
    along_column: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.u)

    def part(self, rows: Rows) -> PixelGeometry:
        """Return the geometry of a subset of the n matched pixels."""
        return select_rows(self, rows)

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) column and row in the left image, px."""
        return np.stack([self.u, self.v], axis=1)

    @property
    def departure(self) -> FloatArray:
        """(n,) measured minus reference disparity, px."""
        return np.asarray(self.found - self.disparity)


@dataclass(frozen=True)
class NominalPair:
    """A stereo pair with the calibration and pose that the measurement states, in the wall frame.

    Disparities are defined by it: they are differences of columns in the images that it rectifies. The real cameras may differ
    from it by errors of calibration and pose.

    Attributes
    ----------
    pair : The two cameras.
    geometry : Rectification of their images to common rows.
    """

    pair: CameraPair
    geometry: Rectification

    @classmethod
    def of(cls, measurement: StereoMeasurement) -> NominalPair:
        """Return the stereo pair of a measurement with its stated calibration and pose, transformed to the wall frame."""
        pair = measurement.cameras.in_wall_frame(measurement.frame)
        return cls(pair, rectify(pair))

    def disparity(self, left: tuple[FloatArray, FloatArray], right: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Return the disparities of matched pixels: the rectified column in the left image minus that in the right image.

        Parameters
        ----------
        left, right : (n,) column and (n,) row of the pixels in the left and in the right original image, px.

        Returns
        -------
        (n,) disparities, px.
        """
        first, second = ([on_device(mi.Float64, each) for each in pixel] for pixel in (left, right))
        return _on_host(self._left(*first)[0] - self._right(*second)[0])[0]

    def surface_disparity(self, scene: RayCaster, u: FloatArray, v: FloatArray, real: CameraPair | None = None) -> FloatArray:
        """Predict the disparity of the surface point that each pixel of the left image sees.

        Parameters
        ----------
        scene : The surface, in the wall frame, prepared for ray tracing.
        u, v : (n,) columns and rows of the pixels in the original (not rectified) left image, px.
        real : The cameras that take the images, wall frame, if they differ from the calibrated ones; None: they do not. The
            images are rectified with the calibrated ones in any case.

        Returns
        -------
        (n,) disparities, px; NaN for pixels that see nothing.
        """
        left, right = (self.pair.left, self.pair.right) if real is None else (real.left, real.right)
        pixel = on_device(mi.Float64, u), on_device(mi.Float64, v)
        origin, ray = vector(left.position), _ray(left, *pixel)
        hits = scene.intersect(origin, ray, coherent=True)
        point = origin + dr.select(hits.valid, hits.distance, dr.nan) * ray
        seen = _pixel(right, point)
        dr.eval(*seen)  # the next kernel is that of `disparity`, and need not be compiled again
        return _on_host(self._left(*pixel)[0] - self._right(*seen)[0])[0]

    def tangent(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Return the vertical slope (n,) of each pixel's line of sight in the rectified left image, to model pixel locking.

        u, v: (n,) columns and rows in the original left image, px. The slope is (row - principal row) / focal length in px.
        """
        pixel = on_device(mi.Float64, u), on_device(mi.Float64, v)
        return _on_host(row_tangent(self.geometry, self._left(*pixel)[1]))[0]

    def _left(self, u: mi.Float64, v: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        """Columns and rows in the rectified left image of pixels of the original one, px, on the device."""
        rect = self.geometry
        return rectified_pixel(self.pair.left, rect.left, u, v, rect.f, rect.u_left, rect.v)

    def _right(self, u: mi.Float64, v: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        """Columns and rows in the rectified right image of pixels of the original one, px, on the device."""
        rect = self.geometry
        return rectified_pixel(self.pair.right, rect.right, u, v, rect.f, rect.u_right, rect.v)

    def _right_column_of(self, real: Camera, point: mi.Array3f64) -> mi.Float64:
        """Columns in the rectified right image at which points (wall frame) appear to the right camera `real`, on the device.

        The real camera takes the image. The image is rectified with the nominal calibration, because the user does not know the
        difference.
        """
        x, y = _seen_tangents(real, point)
        if _interior(real) != _interior(self.pair.right):  # else both cameras have the same tangents
            x, y = self.pair.right.on_device().tangents(*real.on_device().pixel(x, y))
        rect = self.geometry
        return rectified_tangents(x, y, rect.right, rect.f, rect.u_right, rect.v)[0]


def project(camera: Camera, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Project points into the image of a camera, with its lens distortion.

    points: (n, 3), in the frame of the camera's pose, such as the wall frame, m. Returns columns (n,) and rows (n,), px.
    """
    u, v = _on_host(*_pixel(camera, vectors_on_device(points)))
    return u, v


def pixel_rays(camera: Camera, u: FloatArray, v: FloatArray) -> FloatArray:
    """Return the directions (n, 3) in which pixels of a camera look, corrected for lens distortion.

    u, v: (n,) columns and rows, px. The directions are in the frame of the camera's pose, such as the wall frame. They are not of
    unit length: the component along the camera's axis is 1.
    """
    return np.stack(_on_host(*_ray(camera, on_device(mi.Float64, u), on_device(mi.Float64, v))), axis=1)


def _pixel(camera: Camera, point: mi.Array3f64) -> tuple[mi.Float64, mi.Float64]:
    """Column and row at which a camera sees points, on the device."""
    u, v = camera.on_device().pixel(*_seen_tangents(camera, point))
    return u, v


def _seen_tangents(camera: Camera, point: mi.Array3f64) -> tuple[mi.Float64, mi.Float64]:
    """Tangents x / z and y / z of points in a camera, on the device."""
    local = rotated(camera.rotation.T, point - vector(camera.position))
    return local.x / local.z, local.y / local.z


def _interior(camera: Camera) -> tuple[float, ...]:
    """Parameters of the interior orientation, to compare two cameras."""
    return tuple(float(getattr(camera, name)) for name in INTERIOR)


def _ray(camera: Camera, u: mi.Float64, v: mi.Float64) -> mi.Array3f64:
    """Directions of pixels, on the device."""
    return rotated(camera.rotation, mi.Array3f64(*camera.on_device().tangents(u, v), 1.0))


def _on_host(*columns: mi.Float64) -> list[FloatArray]:
    """Copy arrays from the device."""
    dr.eval(*columns)
    return [np.array(column) for column in columns]


def steps_from_planes(
    scene: RayCaster, camera: Camera, u: FloatArray, v: FloatArray, height: FloatArray, normal: FloatArray
) -> FloatArray:
    """Compare the inverse depths of the surface at some pixels with those of planes, to find edges.

    Parameters
    ----------
    scene : The surface, in the wall frame, prepared for ray tracing.
    camera : The camera with its pose in the wall frame.
    u, v : (n, k) columns and rows of k pixels for each of n planes, px.
    height : (n,) heights of the planes above the camera: scalar product of the normal with the way from the camera, m.
    normal : (n, 3) unit normals of the planes, wall frame.

    Returns
    -------
    (n, k) inverse depth of the surface minus that of the plane, along the camera's axis, 1/m; NaN where nothing is hit.
    """
    plane = dr.arange(mi.UInt32, u.size) // u.shape[1]
    heights, normals = (on_device(mi.Float64, each) for each in (height, normal))
    ray = _ray(camera, on_device(mi.Float64, u), on_device(mi.Float64, v))
    hits = scene.intersect(vector(camera.position), ray, coherent=True)
    seen = dr.select(hits.valid, hits.distance, dr.nan)
    flat = dr.gather(mi.Float64, heights, plane) / dr.dot(ray, dr.gather(mi.Array3f64, normals, plane))
    return _on_host(1 / seen - 1 / flat)[0].reshape(u.shape)


def is_hidden(scene: RayCaster, position: FloatArray, points: FloatArray) -> BoolArray:
    """Tell which points (n,) a camera does not see, because the surface `scene` itself lies in front of them (occlusions).

    position: (3,) position of the camera. points: (n, 3) points on the surface; NaN counts as not hidden. Both are in the wall
    frame, m.
    """
    back = np.nan_to_num(points, nan=1e9) - position
    length = np.linalg.norm(back, axis=1)
    return np.asarray(scene.cast(position, back / length[:, None])[0] < length * (1 - _HIDDEN_SHARE))


def predict_disparities(nominal: NominalPair, real: Iterable[CameraPair], geometry: PixelGeometry) -> list[FloatArray]:
    """Predict the disparities at given pixels if the cameras are not where the calibration says.

    Differences of the results give the derivatives of the disparities by pose or calibration. Images are rectified with the
    stated (nominal) calibration, so that an error of the real cameras shows in the disparities. To be fast, the surface is
    replaced by its tangent plane at each pixel's point, and no ray is traced again.

    Parameters
    ----------
    nominal : The pair with its stated calibration.
    real : Pairs as they might really be, such as the nominal one with one camera rotated a little.
    geometry : n pixels of the left image, with the points of the reference surface that they see and its normals.

    Returns
    -------
    A list with the (n,) disparities, px, for each of the real pairs.
    """
    u, v = on_device(mi.Float64, geometry.u), on_device(mi.Float64, geometry.v)
    point, normal = vectors_on_device(geometry.point), vectors_on_device(geometry.normal)
    column, _ = nominal._left(u, v)
    dr.eval(column)
    known: dict[tuple[float, ...], tuple[mi.Float64, mi.Float64]] = {}

    def tangents(camera: Camera) -> tuple[mi.Float64, mi.Float64]:
        interior = _interior(camera)
        if interior not in known:  # most pairs differ only in their pose
            known[interior] = camera.on_device().tangents(u, v)
            dr.eval(*known[interior])
        return known[interior]

    def seen(pair: CameraPair) -> mi.Float64:
        origin = vector(pair.left.position)
        ray = rotated(pair.left.rotation, mi.Array3f64(*tangents(pair.left), 1.0))
        met = origin + dr.dot(point - origin, normal) / dr.dot(ray, normal) * ray
        disparity = column - nominal._right_column_of(pair.right, met)
        dr.eval(disparity)  # launches the same kernel for each pair, without waiting
        return disparity

    return _on_host(*[seen(pair) for pair in real])


def moved_pairs(pair: CameraPair, step: float) -> list[CameraPair]:
    """Return six copies of a camera pair, each moved a little as one rigid body, to compute derivatives by the pose.

    The first three are shifted by `step`, m, along x, y or z. The last three are rotated by `step`, rad, about the axis x, y or
    z through the left camera. The axes are those of the frame of the pair's poses, such as the wall frame.
    """
    units, centre = step * np.eye(3), pair.left.position

    def turned(camera: Camera, vector: FloatArray) -> Camera:
        x, y, z = vector
        turn = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return replace(camera, rotation=turn @ camera.rotation, position=centre + turn @ (camera.position - centre))

    shifted = [pair.shifted("both", unit) for unit in units]
    return [*shifted, *(CameraPair(turned(pair.left, unit), turned(pair.right, unit)) for unit in units)]


def real_pair(effects: tuple[Effect, ...], measurement: StereoMeasurement) -> CameraPair:
    """Return the cameras of a stereo pair, wall frame, as a sensor model says they are: with its errors of calibration and pose.

    effects: effects of the sensor model; those that do not change the cameras are ignored. measurement: the measurement with its
    stated cameras.
    """
    pair = measurement.cameras
    for effect in effects:
        pair = effect.apply(pair, KeyedRandom(0)) if effect.stage == Stage.CAMERA else pair
    return pair.in_wall_frame(measurement.frame)
