"""Disparity residuals of a reconstructed surface: measured and reference disparity of each pixel, nominally rectified."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pipeline.gap.measurement import Measurement
from pipeline.gap.residuals import Residuals
from pipeline.rigid import RigidTransform
from scene.errors import InputError
from scene.keyed_random import KeyedRandom
from scene.mesh import FloatArray
from scene.raycast import RayCaster
from sensors.camera import Camera, CameraPair
from sensors.effects.base import Effect, Stage
from sensors.effects.disparity_empirical import DisparityEmpirical
from sensors.effects.range_empirical import LARGEST
from sensors.model import StereoModel
from sensors.rectify import Rectification, rectify

_PROBE_PX = 3.0
_EDGE_PX = 1.0
"""A surface that departs by more from its tangent plane within some pixels counts as an edge."""
_REGISTRATION_STEPS, _NUDGE = 3, 1e-4
_ON_RAY = 0.1
"""A registration counts as found where it leaves less than this share of the distance from the points to their rays."""
_REGULARIZATION_SHARE = 4 / 9
"""Mean variance of a bilinearly interpolated grid of independent values."""


@dataclass(frozen=True)
class StereoGeometry:
    """Per point: left pixel and right row (px), disparity of the reference (px), tangent point and unit normal (wall frame, m),
    albedo-free texture is not known. pair: nominal cameras, wall frame."""

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


def on_their_rays(left: Camera, points: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Points (n, 3) moved as one rigid body so that they project into the pixels that they were matched at.

    A reconstruction lies on the rays of its pixels until it is registered; the registration, which the points show thus to some
    micrometres, is undone. Gauss-Newton on some thousand points; the points stay where that does not bring them nearer.
    """
    some = slice(None, None, max(len(points) // 4000, 1))
    found, centre = RigidTransform.identity(), points.mean(axis=0)
    for _ in range(_REGISTRATION_STEPS):
        moved = found.apply(points[some])
        miss = _miss(left, moved, u[some], v[some])
        units = _NUDGE * np.eye(6)
        nudges = [RigidTransform.about(centre, unit[3:], unit[:3]) for unit in units]
        slopes = np.stack([(_miss(left, nudge.apply(moved), u[some], v[some]) - miss) / _NUDGE for nudge in nudges], axis=1)
        change = np.asarray(np.linalg.lstsq(slopes, -miss, rcond=None)[0], dtype=np.float64)
        step = RigidTransform.about(centre, change[3:], change[:3])
        found = RigidTransform(step.rotation @ found.rotation, step.rotation @ found.translation + step.translation)
    before, after = (np.sqrt(np.mean(_miss(left, each, u, v) ** 2)) for each in (points, found.apply(points)))
    return found.apply(points) if after < _ON_RAY * before else points


def _miss(left: Camera, points: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """(2 n,) projected minus given pixel, columns first."""
    found = project(left, points)
    return np.concatenate([found[0] - u, found[1] - v])


def seen_disparity(nominal: NominalPair, real: CameraPair, geometry: StereoGeometry) -> FloatArray:
    """(n,) disparity that a real pair gives on each point's tangent plane, in the nominal rectified pair."""
    ray = rays(real.left, geometry.u, geometry.v)
    distance = np.einsum("ni,ni->n", geometry.point - real.left.position, geometry.normal) / np.einsum(
        "ni,ni->n", ray, geometry.normal
    )
    point = real.left.position + distance[:, None] * ray
    return nominal.disparity((geometry.u, geometry.v), project(real.right, point))


def stereo_residuals(measurement: Measurement) -> Residuals:
    """Disparity residuals with predicted spread and covariates; points whose pixel does not see the surface are left out."""
    nominal, model = NominalPair.of(measurement), measurement.model
    assert isinstance(model, StereoModel)
    points, extra = measurement.cloud.points, measurement.cloud.extra
    given = "pixel_x" in extra and "pixel_y" in extra
    if given:
        u, v = (np.asarray(extra[key], dtype=np.float64) for key in ("pixel_x", "pixel_y"))
        points = on_their_rays(nominal.pair.left, points, u, v)
    else:
        u, v = project(nominal.pair.left, points)
    measured = nominal.disparity(project(nominal.pair.left, points), project(nominal.pair.right, points))
    geometry, curvature, depth = _reference(nominal, measurement.scene, u, v, measured)
    hit = np.isfinite(geometry.disparity)
    slope = nominal.geometry.f * nominal.geometry.base_m / depth**2
    covariates = _covariates(nominal, geometry, depth, curvature)
    mean = _mean_error(nominal, model, geometry, measurement) + _empirical(model, covariates)
    whole = Residuals(
        sensor="stereo",
        value=measured - geometry.disparity - mean,
        sigma=np.full(len(u), np.sqrt(predicted_variance(model))),
        unit_m=1 / slope,
        smooth=hit & (curvature < _EDGE_PX),
        pose=_pose(nominal, geometry),
        at=geometry.point[:, :2],
        covariates=covariates,
        index=np.arange(len(u)),
        geometry=geometry,
        shared_noise=(model.noise.regularization_sigma_px**2, _width(nominal, model, depth)),
        notes=() if given else ("no pixel_x, pixel_y: pixels were found by projecting the points",),
    )
    return whole.part(hit)


def _reference(
    nominal: NominalPair, scene: RayCaster, u: FloatArray, v: FloatArray, measured: FloatArray
) -> tuple[StereoGeometry, FloatArray, FloatArray]:
    """What the left pixels see on the reference, the departure from the tangent plane beside it (px), and the depth (m)."""
    left = nominal.pair.left
    ray = rays(left, u, v)
    distance, face = scene.cast(left.position, ray)
    corners = scene.mesh.vertices[scene.mesh.faces[np.maximum(face, 0)]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    point = left.position + distance[:, None] * ray
    right = project(nominal.pair.right, point)
    disparity = nominal.disparity((u, v), right)
    curvature = np.zeros(len(u))
    for du, dv in ((_PROBE_PX, 0.0), (-_PROBE_PX, 0.0), (0.0, _PROBE_PX), (0.0, -_PROBE_PX)):
        beside = rays(left, u + du, v + dv)
        seen = scene.cast(left.position, beside)[0]
        flat = np.einsum("ni,ni->n", point - left.position, normal) / np.einsum("ni,ni->n", beside, normal)
        step = nominal.geometry.f * nominal.geometry.base_m * (1 / seen - 1 / flat)
        curvature = np.maximum(curvature, np.nan_to_num(np.abs(step), nan=np.inf))
    camera = nominal.pair.right
    geometry = StereoGeometry(
        u=u,
        v=v,
        v_right=right[1],
        disparity=disparity,
        found=measured,
        point=point,
        normal=normal,
        radius=np.hypot(u - left.width / 2, v - left.height / 2),
        radius_right=np.hypot(right[0] - camera.width / 2, right[1] - camera.height / 2),
    )
    return geometry, curvature, distance


def _pose(nominal: NominalPair, geometry: StereoGeometry) -> FloatArray:
    """(n, 6) change of the disparity if both cameras stand shifted (m) and turned (rad) about the left one, wall frame."""
    centre, step = nominal.pair.left.position, 1e-4
    base = seen_disparity(nominal, nominal.pair, geometry)
    columns = []
    for axis in range(6):
        vector = np.zeros(3)
        vector[axis % 3] = step
        moved = moved_pair(nominal.pair, centre, vector, turned=axis >= 3)
        columns.append((seen_disparity(nominal, moved, geometry) - base) / step)
    return np.stack(columns, axis=1)


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


def _mean_error(nominal: NominalPair, model: StereoModel, geometry: StereoGeometry, measurement: Measurement) -> FloatArray:
    """(n,) what the model's effects add to the disparity, px."""
    from pipeline.gap.stereo_signatures import exposure_and_locking

    real = real_pair(nominal, model.effects, measurement)
    plain = seen_disparity(nominal, nominal.pair, geometry)
    return seen_disparity(nominal, real, geometry) - plain + exposure_and_locking(model.effects, geometry)


def _empirical(model: StereoModel, covariates: dict[str, FloatArray]) -> FloatArray:
    """(n,) what empirical terms of the model add to the disparity, px (see DisparityEmpirical)."""
    total = np.zeros(len(covariates["depth"]))
    for effect in model.effects:
        if isinstance(effect, DisparityEmpirical):
            t = np.clip((covariates[effect.covariate] - effect.centre) / effect.scale, -LARGEST, LARGEST)
            total += sum((c * t**power for power, c in enumerate(effect.coefficients_px, start=1)), np.zeros(len(t)))
    return total


def predicted_variance(model: StereoModel) -> float:
    """Variance of a disparity that the model predicts, px^2, on average over the grid of the regularization."""
    noise = model.noise
    total = noise.parallax_sigma_px**2 + _REGULARIZATION_SHARE * noise.regularization_sigma_px**2
    for effect in model.effects:
        values: Any = effect
        if effect.name in ("parallax_noise", "heavy_tailed_noise"):
            total += values.sigma_px**2
        elif effect.name == "regularization_noise":
            total += _REGULARIZATION_SHARE * values.sigma_px**2
    return float(max(total, 1e-8))


def _width(nominal: NominalPair, model: StereoModel, depth: FloatArray) -> float:
    """Distance on the wall of the nodes of the regularization's grid, m."""
    return float(model.noise.regularization_step_px * np.nanmedian(depth) / nominal.geometry.f)


def _covariates(
    nominal: NominalPair, geometry: StereoGeometry, depth: FloatArray, curvature: FloatArray
) -> dict[str, FloatArray]:
    ray = geometry.point - nominal.pair.left.position
    cosine = np.abs(np.einsum("ni,ni->n", ray, geometry.normal)) / np.linalg.norm(ray, axis=1)
    return {
        "depth": depth,
        "image_x": geometry.u,
        "image_y": geometry.v,
        "radius": geometry.radius,
        "disparity": geometry.disparity,
        "disparity_fraction": geometry.found - np.floor(geometry.found),
        "incidence": np.arccos(np.clip(cosine, 0, 1)),
        "edge_step": np.minimum(curvature, 10.0),
    }
