"""The nominal pair of cameras in the wall frame: pixels to rays and back, disparities in its rectification, and the real pair."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pipeline.gap.measurement import Measurement
from pipeline.gap.residuals import BoolArray
from scene.errors import InputError
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from scene.raycast import RayCaster
from sensors.camera import Camera, CameraPair
from sensors.effects.base import Effect, Stage
from sensors.rectify import Rectification, rectify

_HIDDEN_SHARE = 2e-4
"""A point is hidden where another surface stands before it by this share of its distance."""


@dataclass(frozen=True)
class StereoGeometry:
    """Per point: left pixel (u, v) and row in the right image (px), disparity of the reference and as found (px), point and unit
    normal of the reference (n, 3), wall frame, m, and distances to the middles of both images (px)."""

    u: FloatArray
    v: FloatArray
    v_right: FloatArray
    disparity: FloatArray
    found: FloatArray
    point: FloatArray
    normal: FloatArray
    radius: FloatArray
    radius_right: FloatArray

    def part(self, rows: Any) -> StereoGeometry:
        """The same of some of the points."""
        return StereoGeometry(**{column.name: getattr(self, column.name)[rows] for column in fields(self)})


@dataclass(frozen=True)
class NominalPair:
    """The nominal pair in the wall frame, with its rectification."""

    pair: CameraPair
    geometry: Rectification

    @classmethod
    def of(cls, measurement: Measurement) -> NominalPair:
        """Raises InputError where a stereo measurement has no cameras."""
        if measurement.cameras is None:
            raise InputError("a stereo measurement needs `cameras`", where="measurement.yaml")
        pair = measurement.cameras.in_wall_frame(measurement.frame)
        return cls(pair, rectify(pair))

    def rectified(self, camera: Camera, turn: FloatArray, u: FloatArray, v: FloatArray, centre: float) -> FloatArray:
        """(n,) rectified column of image pixels."""
        x, y = camera.tangents(u, v)
        ray = np.einsum("ij,nj->ni", turn, np.stack([x, y, np.ones_like(x)], axis=1))
        return np.asarray(self.geometry.f * ray[:, 0] / ray[:, 2] + centre)

    def disparity(self, left: tuple[FloatArray, FloatArray], right: tuple[FloatArray, FloatArray]) -> FloatArray:
        """(n,) disparity of pixels of the left and of the right image, px."""
        rect = self.geometry
        return self.rectified(self.pair.left, rect.left, *left, rect.u_left) - self.rectified(
            self.pair.right, rect.right, *right, rect.u_right
        )


def project(camera: Camera, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (u, v) of points (n, 3)."""
    local = np.einsum("ji,nj->ni", camera.rotation, points - camera.position)
    u, v = camera.pixel(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
    return np.asarray(u), np.asarray(v)


def rays(camera: Camera, u: FloatArray, v: FloatArray) -> FloatArray:
    """(n, 3) directions of pixels with unit component along the camera's axis."""
    x, y = camera.tangents(u, v)
    return np.einsum("ij,nj->ni", camera.rotation, np.stack([x, y, np.ones_like(x)], axis=1))


def is_hidden(scene: RayCaster, position: FloatArray, points: FloatArray) -> BoolArray:
    """(n,) whether another surface stands before points (n, 3) of the scene, seen from a position; a point that is NaN is not."""
    back = np.nan_to_num(points, nan=1e9) - position
    length = np.linalg.norm(back, axis=1)
    return np.asarray(scene.cast(position, back / length[:, None])[0] < length * (1 - _HIDDEN_SHARE))


def seen_disparity(nominal: NominalPair, real: CameraPair, geometry: StereoGeometry) -> FloatArray:
    """(n,) disparity that a real pair gives on each point's tangent plane, in the nominal rectified pair."""
    ray = rays(real.left, geometry.u, geometry.v)
    distance = np.einsum("ni,ni->n", geometry.point - real.left.position, geometry.normal) / np.einsum(
        "ni,ni->n", ray, geometry.normal
    )
    point = real.left.position + distance[:, None] * ray
    return nominal.disparity((geometry.u, geometry.v), project(real.right, point))


def moved_pair(pair: CameraPair, centre: FloatArray, vector: FloatArray, *, turned: bool) -> CameraPair:
    """The pair shifted by `vector` (m) or turned by it (rad, small) about `centre`, in the frame that it is given in."""
    if not turned:
        return pair.shifted("both", vector)
    x, y, z = vector
    turn = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sides = (
        Camera(**{**camera.__dict__, "rotation": turn @ camera.rotation, "position": centre + turn @ (camera.position - centre)})
        for camera in (pair.left, pair.right)
    )
    return CameraPair(*sides)


def real_pair(nominal: NominalPair, effects: tuple[Effect, ...], measurement: Measurement) -> CameraPair:
    """The nominal pair with camera effects, wall frame."""
    pair = measurement.cameras
    assert pair is not None
    for effect in effects:
        pair = effect.apply(pair, KeyedRandom(0)) if effect.stage == Stage.CAMERA else pair
    return pair.in_wall_frame(measurement.frame)
