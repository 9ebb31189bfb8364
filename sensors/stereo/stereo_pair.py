"""Simulate a stereo pair of fixed cameras whose matching is simulated by ray tracing.

1  The real pair is the calibrated (nominal) one with the camera effects added.
2  A ray is cast through the centre of each cell of the left depth map, with the real left camera. The point that it hits is
   projected into the real right camera and must be visible from there. If an exposure displaces image rows, the ray of a left
   pixel is that of the undisplaced one, and the right pixel is recorded displaced.
3  Both pixels are undistorted and rectified with the nominal calibration. Their disparity plus the matching effects is what a
   matcher would report.
4  The disparity is reprojected with the nominal calibration to the recorded point. Effects that are given in metres then move
   the point along the surface's normal.

Limits: the matcher follows the row; a vertical parallax, where real and nominal calibration differ, does not disturb it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from scene.common.backend import dr, mi
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import WALL, FloatArray
from scene.ray_casting.raycast import Hits, RayCaster
from scene.ray_casting.upload import vectors_on_device
from sensors.cameras.camera import Camera, CameraPair
from sensors.cameras.rectification import Rectification, rectify
from sensors.effects.base import Effect, Stage, apply_stage
from sensors.models.sensor_model import StereoModel
from sensors.numerics.device import opaque, rotated, vector
from sensors.signal_chain.matches import ImageRows, Matches
from sensors.signal_chain.observation import Observation, offset_of, packed
from sensors.stereo.point_errors import active_point_effects, point_shifts

Quality = Literal["high", "medium", "low"]
REDUCTION: dict[Quality, int] = {"high": 2, "medium": 4, "low": 8}
"""Frame pixels per cell of the depth map, along a row or a column."""

SHADOW_MARGIN = 3e-5
"""Share of the ray from the right camera that is not tested for occlusion: 3 mm at 100 m, where float32 resolves 0.01 mm."""


@dataclass(frozen=True)
class StereoPair:
    """A calibrated pair of cameras with a model of its errors, which simulates depth maps without rendering photographs.

    Attributes
    ----------
    cameras : CameraPair
        The cameras by their nominal calibration, world frame.
    frame : WallFrame
        The wall frame, in which scenes are given.
    model : StereoModel
        Noise and other errors.
    quality : str
        Resolution of the depth map: "high", "medium" or "low" (a cell for 2 x 2, 4 x 4 or 8 x 8 px of the image).
    truth : bool
        Whether observations keep error-free quantities, such as the true depth.
    """

    cameras: CameraPair
    frame: WallFrame
    model: StereoModel
    quality: Quality = "medium"
    truth: bool = False

    def observe(self, scene: RayCaster, random: KeyedRandom) -> Observation:
        """Observe the scene once: simulate the depth map of the left image, and compute points with the nominal calibration.

        scene: the wall, wall frame. random: source of random numbers. Rows and columns are those of the left image, reduced to
        the map's resolution.
        """
        effects = self.model.chain(random)
        matches, left_u, left_v, point = self.traced(scene, effects, random)
        for stage in (Stage.MATCH, Stage.FILL):
            matches = apply_stage(effects, stage, matches, random)
        nominal = self.cameras.in_wall_frame(self.frame)
        found = reproject(rectify(nominal), left_u, left_v, matches.disparity)
        if moving := active_point_effects(effects):
            seen = packed(dr.select(matches.matched, point, np.nan)).numpy().reshape(-1, 3)
            found += rotated(nominal.left.rotation.T, vectors_on_device(point_shifts(scene.mesh, moving, seen, random)))
        return self.recorded(matches, found, nominal.left, point)

    def traced(
        self, scene: RayCaster, effects: tuple[Effect, ...], random: KeyedRandom
    ) -> tuple[Matches, mi.Float64, mi.Float64, mi.Array3f64]:
        """Trace what the real pair of cameras sees, before the errors of the matching.

        Parameters
        ----------
        scene : RayCaster
            The wall, wall frame.
        effects : tuple of Effect
            Errors of the sensor, of which those of cameras and image rows act here.
        random : KeyedRandom
            Source of random numbers.

        Returns
        -------
        Matches
            The n cells of the left depth map with their disparities.
        u, v : (n,)
            Columns and rows of the cells in the left image as rectified with the nominal (calibrated) cameras, px.
        points : 3 x (n,)
            True points that the cells see, wall frame, m.
        """
        nominal = self.cameras.in_wall_frame(self.frame)
        real = self.real_pair(effects, random).in_wall_frame(self.frame)
        index, u, v = self.cells()
        hits, point = view(scene, real.left, u - row_displacement(effects, "left", v, random), v)
        matched, right_u, right_v = _visible(scene, real.right, hits, point)
        right_u += row_displacement(effects, "right", right_v, random)
        geometry = rectify(nominal)
        left_u, left_v, disparity = rectified_disparity(nominal, geometry, (u, v), (right_u, right_v))
        seen = hits.block, hits.distance, None if scene.mesh.vertex_albedo is None else hits.albedo
        size = nominal.left.width, nominal.left.height, REDUCTION[self.quality]
        rows = row_tangent(geometry, left_v), float(geometry.offset)
        return Matches(index, u, v, disparity, matched, *seen, *size, *rows), left_u, left_v, point

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the depth map that the pair records."""
        step = REDUCTION[self.quality]
        return self.cameras.left.height // step, self.cameras.left.width // step

    def real_pair(self, effects: tuple[Effect, ...], random: KeyedRandom) -> CameraPair:
        """Return the pair as it really is, world frame: the calibrated one with the cameras' errors added.

        effects: errors of the sensor, of which those of cameras act here. random: source of random numbers.
        """
        return apply_stage(effects, Stage.CAMERA, self.cameras, random)

    def cells(self) -> tuple[mi.UInt32, mi.Float64, mi.Float64]:
        """Return number and centre (u, v), px of the full-resolution frame, of each cell of the depth map in the left image."""
        rows, columns = self.shape
        index = dr.arange(mi.UInt32, rows * columns)
        return index, *self.centres(index)

    def centres(self, index: mi.UInt32) -> tuple[mi.Float64, mi.Float64]:
        """Return the centres of the depth map's cells in the left image: columns u and rows v, px of the full-resolution frame.

        index: (n,) numbers of the cells, counted row by row.
        """
        step = REDUCTION[self.quality]
        columns = self.cameras.left.width // step
        row, column = index // columns, index % columns
        return (mi.Float64(column) + 0.5) * float(step), (mi.Float64(row) + 0.5) * float(step)

    def recorded(self, matches: Matches, camera_point: mi.Array3f64, left: Camera, true_point: mi.Array3f64) -> Observation:
        """Make the observation that the pair records, with its points in the wall frame.

        Parameters
        ----------
        matches : Matches
            The n matched cells of the depth map after all errors of the matching.
        camera_point : 3 x (n,)
            Recorded points in the nominal left camera's frame, m.
        left : Camera
            The nominal left camera, wall frame.
        true_point : 3 x (n,)
            Points that the pixels really see, wall frame, m.

        Raises
        ------
        InputError
            If both cameras see no part of the wall in common.
        """
        valid = matches.matched & (camera_point.z > 0)
        depth = dr.select(valid, camera_point.z, np.nan)
        point = dr.select(valid, rotated(left.rotation, camera_point) + vector(left.position), np.nan)
        block = dr.select(valid, matches.block, WALL)
        truth = {"true_depth_m": dr.select(valid, matches.true_depth, np.nan)} if self.truth else {}
        points, offset = packed(point), offset_of(point, true_point)
        dr.eval(points, offset, depth, block, truth, valid)
        if dr.none(valid):
            raise InputError(
                "no part of the wall is seen by both cameras",
                where="cameras",
                remedy="correct position_m and rotation of both cameras (camera to world; x right, y down, "
                "z forward) so that they look at the front of the wall",
            )
        shape = self.shape
        return Observation(
            sensor="stereo",
            points=points.numpy().reshape(*shape, 3),
            depth=depth.numpy().reshape(shape),
            block=block.numpy().reshape(shape),
            viewpoint=left.position,
            truth={name: channel.numpy().reshape(shape) for name, channel in truth.items()},
            offset=offset.numpy().reshape(*shape, 2),
        )


def reproject(geometry: Rectification, u: Any, v: Any, disparity: Any) -> mi.Array3f64:
    """Compute points 3 x (n,) in the left camera's frame, m, from rectified left pixels and their disparity, px.

    It computes Z = f B / (d - d_inf), X = (u - u_left) Z / f, Y = (v - v_0) Z / f, and rotates back from the rectified frame.
    Here d is the disparity, d_inf that of a point at infinity, f the principal distance, B the base, and (u_left, v_0) the
    principal point. OpenCV's matrix Q does the same.

    Parameters
    ----------
    geometry : Rectification
        The nominal rectification.
    u, v : (n,)
        Rectified left pixels, px.
    disparity : (n,)
        Disparity, px.
    """
    f, u_left, v_0, infinity, base = opaque(geometry.f, geometry.u_left, geometry.v, geometry.offset, geometry.base_m)
    z = f * base / (disparity - infinity)
    return rotated(geometry.left.T, mi.Array3f64((u - u_left) / f * z, (v - v_0) / f * z, z))


def row_displacement(
    effects: tuple[Effect, ...], camera: Literal["left", "right"], v: mi.Float64, random: KeyedRandom
) -> mi.Float64:
    """Return how far the image rows of one camera are displaced sideways by errors: recorded minus ideal column (n,), px.

    Parameters
    ----------
    effects : tuple of Effect
        Errors of the sensor, of which those that displace image rows act.
    camera : str
        "left" or "right".
    v : (n,)
        Rows of the pixels, px.
    random : KeyedRandom
        Source of random numbers.
    """
    return apply_stage(effects, Stage.EXPOSE, ImageRows(camera, v, mi.Float64(0.0)), random).du


def view(scene: RayCaster, camera: Camera, u: mi.Float64, v: mi.Float64) -> tuple[Hits, mi.Array3f64]:
    """Find what the pixels of a camera see, by ray casting.

    scene: the wall. camera: the camera, in the scene's frame. u, v: (n,) columns and rows, px. Returns the hits, whose distance
    is the depth along the camera's axis, and the points 3 x (n,), m.
    """
    x, y = camera.on_device().tangents(u, v)
    origin, direction = vector(camera.position), rotated(camera.rotation, mi.Array3f64(x, y, 1.0))
    hits = scene.intersect(origin, direction, exact=True)
    return hits, origin + hits.distance * direction


def _visible(scene: RayCaster, camera: Camera, hits: Hits, point: mi.Array3f64) -> tuple[mi.Bool, mi.Float64, mi.Float64]:
    """Return whether `camera` sees each point that was hit, on its front side, and at which pixel (u, v)."""
    centre = vector(camera.position)
    sight = point - centre
    local = rotated(camera.rotation.T, sight)
    u, v = camera.on_device().pixel(local.x / local.z, local.y / local.z)
    inside = (local.z > 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
    seen = hits.valid & inside & (dr.dot(hits.normal, mi.Vector3f(sight)) < 0)
    return seen & ~scene.occluded(centre, sight, 1.0 - SHADOW_MARGIN), u, v


def rectified_disparity(
    nominal: CameraPair, geometry: Rectification, left: tuple[mi.Float64, mi.Float64], right: tuple[mi.Float64, mi.Float64]
) -> tuple[mi.Float64, mi.Float64, mi.Float64]:
    """Compute the disparities of corresponding pixels of two images: returns rectified left pixels u, v and disparities, px.

    Parameters
    ----------
    nominal : CameraPair
        The nominal cameras.
    geometry : Rectification
        Their rectification.
    left, right : (u, v)
        Columns and rows (n,) of the corresponding pixels in each image, px.
    """
    left_u, left_v = rectified_pixel(nominal.left, geometry.left, *left, geometry.f, geometry.u_left, geometry.v)
    right_u, _ = rectified_pixel(nominal.right, geometry.right, *right, geometry.f, geometry.u_right, geometry.v)
    return left_u, left_v, left_u - right_u


def row_tangent(geometry: Rectification, v: mi.Float64) -> mi.Float64:
    """Return the tangent (n,) of how far lines of sight in rectified rows point below the rectified axis, such as for a tilt.

    It is Y/Z in the frame of the rectified camera (y down, z forward).

    geometry: the rectification of the cameras. v: (n,) rows of the rectified image, px.
    """
    scale, centre = opaque(geometry.f, geometry.v)
    return (v - centre) / scale


def rectified_pixel(
    camera: Camera, rotation: FloatArray, u: mi.Float64, v: mi.Float64, f: float, u_0: float, v_0: float
) -> tuple[mi.Float64, mi.Float64]:
    """Convert pixels of an image to pixels (column, row) of the rectified image.

    Parameters
    ----------
    camera : Camera
        The camera of the image.
    rotation : (3, 3) array
        Camera frame to rectified frame.
    u, v : (n,)
        Columns and rows in the image, px.
    f, u_0, v_0 : float
        Principal distance and principal point of the rectified image, px.
    """
    return rectified_tangents(*camera.on_device().tangents(u, v), rotation, f, u_0, v_0)


def rectified_tangents(
    x: mi.Float64, y: mi.Float64, rotation: FloatArray, f: float, u_0: float, v_0: float
) -> tuple[mi.Float64, mi.Float64]:
    """Convert ideal image coordinates (directions in a camera's frame) to pixels of a rectified image.

    Parameters
    ----------
    x, y : (n,)
        Tangents X/Z and Y/Z in the camera's frame, without distortion.
    rotation : (3, 3) array
        Rotation from the camera's frame to the rectified frame.
    f : float
        Principal distance of the rectified image, px.
    u_0, v_0 : float
        Principal point of the rectified image, px.

    Returns
    -------
    (n,) and (n,)
        Columns and rows, px.
    """
    ray = rotated(rotation, mi.Array3f64(x, y, 1.0))
    scale, centre_u, centre_v = opaque(f, u_0, v_0)
    return scale * ray.x / ray.z + centre_u, scale * ray.y / ray.z + centre_v
