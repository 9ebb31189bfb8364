"""Disparity residuals of a reconstructed surface: measured and reference disparity of each pixel, nominally rectified."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.formats.measurements.measurement import StereoMeasurement
from pipeline.formats.measurements.surroundings import Surroundings
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from pipeline.gap.residuals.disparity_raster import (
    MOST_CELLS,
    DisparityRaster,
    apply_smoothing,
    raster_cell_count,
    raster_cell_px,
)
from pipeline.gap.residuals.nominal_pair import (
    NominalPair,
    PixelGeometry,
    is_hidden,
    moved_pair,
    pixel_rays,
    predict_disparities,
    project,
    real_pair,
)
from pipeline.gap.residuals.residuals import Residuals
from pipeline.registration.rigid import RigidTransform
from scene.geometry.mesh import FloatArray
from scene.ray_casting.raycast import RayCaster
from sensors.cameras.camera import Camera, CameraPair
from sensors.effects.camera_effect import CameraEffect
from sensors.effects.disparity_empirical import DisparityEmpirical
from sensors.effects.parallax_noise import ParallaxNoise
from sensors.effects.raster_effect import RasterEffect
from sensors.models.sensor_model import StereoModel
from sensors.numerics.curve import interpolate_on_host

_PROBE_PX = 3.0
_EDGE_PX, _MOST_EDGE_PX = 1.0, 10.0
"""A surface that departs by more from its tangent plane within some pixels counts as an edge; the most that is told apart."""
_STAYS_PX = 0.5
"""A pixel that sees a place no farther from another, a sixth of what is probed about it, has that one's surroundings."""
_LEAST_VARIANCE = 1e-8
"""Of a disparity, px2: a model without noise divides by nothing."""
_REGISTRATION_STEPS, _NUDGE = 3, 1e-4
_ON_RAY = 0.1
"""A registration counts as found where it leaves less than this share of the distance from the points to their rays."""


@dataclass(frozen=True)
class StereoResiduals(Residuals):
    """Residuals of disparities, px."""

    sensor = "stereo"
    position_covariates = ("image_x", "image_y")
    empirical_term = DisparityEmpirical, "values_px"
    white_noise = ParallaxNoise, "sigma_px"
    label = "disparities of a stereo pair"
    geometry: PixelGeometry

    @property
    def depth_m(self) -> FloatArray:
        """(n,) m per px, below 0: a disparity, f B / Z, falls with the depth."""
        return -self.unit_m


def move_onto_rays(left: Camera, points: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
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
        found = RigidTransform.about(centre, change[3:], change[:3]).after(found)
    before, after = (np.sqrt(np.mean(_miss(left, each, u, v) ** 2)) for each in (points, found.apply(points)))
    return found.apply(points) if after < _ON_RAY * before else points


def _miss(left: Camera, points: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """(2 n,) projected minus given pixel, columns first."""
    found = project(left, points)
    return np.concatenate([found[0] - u, found[1] - v])


def stereo_residuals(measurement: StereoMeasurement) -> StereoResiduals:
    """Disparity residuals with predicted spread and covariates; points whose pixel does not see the surface are left out."""
    nominal, model = NominalPair.of(measurement), measurement.model
    u, v, points = _pixels(nominal, measurement)
    measured = nominal.disparity(project(nominal.pair.left, points), project(nominal.pair.right, points))
    real = real_pair(nominal, model.effects, measurement)
    geometry, depth = _reference(nominal, real, measurement.scene, u, v, measured)
    about = _surroundings(measurement, nominal, real, geometry, depth)
    geometry = replace(geometry, shaped=_shaped_px(measurement, geometry))
    hit = np.isfinite(geometry.disparity)
    slope = nominal.geometry.f * nominal.geometry.base_m / depth**2
    covariates = _covariates(nominal, geometry, depth, about)
    mean = _mean_error(model, geometry) + _empirical(model, covariates)
    even = hit & ~about.hidden & (about.edge_px < _EDGE_PX)
    whole = StereoResiduals(
        value=measured - geometry.disparity - mean,
        sigma=np.full(len(u), np.sqrt(max(model.variance, _LEAST_VARIANCE))),
        unit_m=1 / slope,
        usable=even & measurement.stable,
        on_smooth_surface=even,
        pose_jacobian=apply_smoothing(model.effects, geometry, _pose(nominal, geometry)),
        wall_xy=geometry.point[:, :2],
        covariates=covariates,
        index=np.arange(len(u)),
        geometry=geometry,
        correlated_noise=GridCorrelatedNoise.of(model, np.stack([u, v], axis=1)),
        notes=(*measurement.notes, *_notes(_recorded(measurement), u, v)),
    )
    return whole if hit.all() else whole.part(hit)


def with_surroundings(measurement: StereoMeasurement, found: StereoResiduals) -> StereoMeasurement:
    """With what lies about the places that the pixels see, which is not looked for again where these move little.

    found: its residuals, of which it is taken. What the right camera does not see is taken over too, wherever it stands: a few
    points beside edges where it moves far.
    """
    edge = found.covariates["edge_step"]
    about = Surroundings(found.geometry.point, edge, ~found.on_smooth_surface & (edge < _EDGE_PX))
    everywhere = Surroundings.nowhere(len(measurement.cloud.points))
    return measurement.changed(surroundings=everywhere.changed(found.index, about))


def _recorded(measurement: StereoMeasurement) -> bool:
    """Whether the points come with their pixels."""
    return "pixel_x" in measurement.cloud.extra and "pixel_y" in measurement.cloud.extra


def _pixels(nominal: NominalPair, measurement: StereoMeasurement) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Column and row (n,) of each point in the left image, px, and the points (n, 3) on the rays of these."""
    points, left = measurement.cloud.points, nominal.pair.left
    if not _recorded(measurement):
        return *project(left, points), points
    u, v = (np.asarray(measurement.cloud.extra[key], dtype=np.float64) for key in ("pixel_x", "pixel_y"))
    return u, v, move_onto_rays(left, points, u, v)


def _notes(given: bool, u: FloatArray, v: FloatArray) -> tuple[str, ...]:
    """What cannot be looked into for want of a field. given: whether the pixels are recorded."""
    step = raster_cell_px(u, v)
    large = step is not None and raster_cell_count(u, v, step) > MOST_CELLS
    absent = {
        "no pixel_x, pixel_y: pixels were found by projecting the points": not given,
        "pixels on no raster: edge_fattening, smoothing and occlusion_fill were not tried": step is None,
        f"a raster of more than {MOST_CELLS:,} cells: edge_fattening, smoothing and occlusion_fill were not tried": large,
        "no images: texture_noise was not tried": True,
    }
    return tuple(note for note, true in absent.items() if true)


def _reference(
    nominal: NominalPair, real: CameraPair, scene: RayCaster, u: FloatArray, v: FloatArray, measured: FloatArray
) -> tuple[PixelGeometry, FloatArray]:
    """What the pixels of the cameras as the model has them (`real`) see on the reference, its disparity in the nominal pair, and
    the depth (m)."""
    left, camera = real.left, real.right
    ray = pixel_rays(left, u, v)
    distance, face = scene.cast(left.position, ray)
    point = left.position + distance[:, None] * ray
    right = project(camera, point)
    geometry = PixelGeometry(
        u=u,
        v=v,
        v_right=right[1],
        disparity=nominal.disparity((u, v), right),
        found=measured,
        point=point,
        normal=scene.mesh.normals[np.maximum(face, 0)],
        radius=np.hypot(u - left.width / 2, v - left.height / 2),
        radius_right=np.hypot(right[0] - camera.width / 2, right[1] - camera.height / 2),
        tangent=nominal.tangent(u, v),
        infinity=np.full(len(u), nominal.geometry.offset),
        shaped=np.zeros(len(u)),
    )
    return geometry, distance


def _surroundings(
    measurement: StereoMeasurement, nominal: NominalPair, real: CameraPair, geometry: PixelGeometry, depth: FloatArray
) -> Surroundings:
    """Those that the measurement knows, and what the pixels that see other places have about them."""
    known = measurement.surroundings or Surroundings.nowhere(len(geometry))
    away_px = nominal.geometry.f * np.linalg.norm(geometry.point - known.point, axis=1) / depth
    rows = np.flatnonzero(np.isfinite(depth) & ~(away_px < _STAYS_PX))
    if not len(rows):
        return known
    moved = geometry.part(rows)
    edge = _edge_px(nominal, real.left, measurement.scene, moved)
    return known.changed(rows, Surroundings(moved.point, edge, is_hidden(measurement.scene, real.right.position, moved.point)))


def _edge_px(nominal: NominalPair, left: Camera, scene: RayCaster, geometry: PixelGeometry) -> FloatArray:
    """(n,) departure of the reference from its tangent planes beside what the pixels see, px of disparity."""
    edge = np.zeros(len(geometry))
    for du, dv in ((_PROBE_PX, 0.0), (-_PROBE_PX, 0.0), (0.0, _PROBE_PX), (0.0, -_PROBE_PX)):
        beside = pixel_rays(left, geometry.u + du, geometry.v + dv)
        seen = scene.cast(left.position, beside)[0]
        flat = np.einsum("ni,ni->n", geometry.point - left.position, geometry.normal)
        flat /= np.einsum("ni,ni->n", beside, geometry.normal)
        step = nominal.geometry.f * nominal.geometry.base_m * (1 / seen - 1 / flat)
        edge = np.maximum(edge, np.nan_to_num(np.abs(step), nan=_MOST_EDGE_PX))
    return np.minimum(edge, _MOST_EDGE_PX)


def _pose(nominal: NominalPair, geometry: PixelGeometry) -> FloatArray:
    """(n, 6) change of the disparity if both cameras stand shifted (m) and turned (rad) about the left one, wall frame."""
    centre, step = nominal.pair.left.position, 1e-4
    units = step * np.eye(3)
    moved = [moved_pair(nominal.pair, centre, unit, turned=turned) for turned in (False, True) for unit in units]
    base, *columns = predict_disparities(nominal, [nominal.pair, *moved], geometry)
    return np.stack([(column - base) / step for column in columns], axis=1)


def _mean_error(model: StereoModel, geometry: PixelGeometry) -> FloatArray:
    """(n,) what those of the model's effects that are not in the cameras add to the disparity, px."""
    beside = [effect for effect in model.effects if not effect.empirical and not isinstance(effect, CameraEffect | RasterEffect)]
    found = np.asarray(sum((effect.mean(geometry) for effect in beside), np.zeros(len(geometry))))
    return found + geometry.shaped


def _shaped_px(measurement: StereoMeasurement, geometry: PixelGeometry) -> FloatArray:
    """(n,) what those of the model's effects that look at neighbouring pixels add to the disparity, px."""
    shapes = [effect for effect in measurement.model.effects if isinstance(effect, RasterEffect)]
    if not shapes:
        return np.zeros(len(geometry))
    if measurement.shaped_px is not None:
        return measurement.shaped_px
    raster = DisparityRaster.of(measurement, geometry)
    return np.zeros(len(geometry)) if raster is None else raster.added_by(shapes, geometry.disparity)


def _empirical(model: StereoModel, covariates: dict[str, FloatArray]) -> FloatArray:
    """(n,) what empirical terms of the model add to the disparity, px (see DisparityEmpirical)."""
    total = np.zeros(len(covariates["depth"]))
    for effect in model.effects:
        if isinstance(effect, DisparityEmpirical):
            x, y = (covariates[name] for name in (effect.covariate, effect.second or effect.covariate))
            total += interpolate_on_host(x, y, effect.along, effect.across, effect.values_px)
    return total


def _covariates(nominal: NominalPair, geometry: PixelGeometry, depth: FloatArray, about: Surroundings) -> dict[str, FloatArray]:
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
        "edge_step": about.edge_px,
    }
