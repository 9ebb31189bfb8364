"""Compute the disparity residuals of a stereo pair: measured minus reference disparity, nominally rectified."""

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
    moved_pairs,
    pixel_rays,
    predict_disparities,
    project,
    real_pair,
    steps_from_planes,
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
"""Distance to the neighbouring pixels that detect edges, px."""
_EDGE_PX, _MOST_EDGE_PX = 1.0, 10.0
"""Deviation of the surface from its tangent plane, px of disparity, from which a pixel counts as an edge; and the largest
recorded.
"""
_STAYS_PX = 0.5
"""Surroundings are kept if a pixel sees a place at most this far from the earlier one, px: a sixth of the probing distance."""
_LEAST_VARIANCE = 1e-8
"""Smallest variance of a disparity, px², so that a model without noise does not cause divisions by 0."""
_REGISTRATION_STEPS, _NUDGE = 3, 1e-4
"""Gauss-Newton steps, and step of the finite differences, m and rad."""
_ON_RAY = 0.1
"""The registration counts as found if it leaves less than this share of the distances between points and rays."""


@dataclass(frozen=True)
class StereoResiduals(Residuals):
    """Residuals of a stereo pair: measured minus predicted disparities, px. See `Residuals` for the attributes."""

    sensor = "stereo"
    position_covariates = ("image_x", "image_y")
    empirical_term = DisparityEmpirical, "values_px"
    white_noise = ParallaxNoise, "sigma_px"
    label = "disparities of a stereo pair"
    geometry: PixelGeometry

    @property
    def depth_m(self) -> FloatArray:
        """(n,) change of depth per px of disparity, m/px. It is negative: a larger disparity means a nearer point."""
        return -self.unit_m


def move_onto_rays(left: Camera, points: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Undo the registration of a stereo reconstruction: move its points rigidly so that they project into their matched pixels.

    A reconstruction lies on the rays of its pixels until it is registered to other data. Measured disparities can only be
    computed from points on these rays. The motion is found by Gauss-Newton iteration from some thousand points. It is applied
    only if it reduces the reprojection error to less than a tenth; otherwise the points are returned unmoved.

    points: (n, 3), in the frame of the left camera's pose, m. u, v: (n,) columns and rows at which they were matched in the left
    image, px.
    """
    some = slice(None, None, max(len(points) // 4000, 1))
    found, centre = RigidTransform.identity(), points.mean(axis=0)
    for _ in range(_REGISTRATION_STEPS):
        moved = found.apply(points[some])
        units = _NUDGE * np.eye(6)
        nudged = [moved, *(RigidTransform.about(centre, unit[3:], unit[:3]).apply(moved) for unit in units)]
        miss, *misses = _reprojection_errors(left, nudged, u[some], v[some])
        jacobian = np.stack([(each - miss) / _NUDGE for each in misses], axis=1)
        change = np.asarray(np.linalg.lstsq(jacobian.T @ jacobian, -jacobian.T @ miss, rcond=None)[0], dtype=np.float64)
        found = RigidTransform.about(centre, change[3:], change[:3]).after(found)
    everywhere = _reprojection_errors(left, [points, found.apply(points)], u, v)
    before, after = np.sqrt(np.mean(everywhere**2, axis=1))
    return found.apply(points) if after < _ON_RAY * before else points


def _reprojection_errors(left: Camera, clouds: list[FloatArray], u: FloatArray, v: FloatArray) -> FloatArray:
    """(k, 2 n) reprojection errors of n points at k poses, px: the errors of their image columns, then those of their rows.

    clouds: (n, 3) points at each pose. u, v: (n,) columns and rows at which they were matched, which are subtracted.
    """
    projected = project(left, np.concatenate(clouds))
    columns, rows = (each.reshape(len(clouds), -1) for each in projected)
    return np.concatenate([columns - u, rows - v], axis=1)


def stereo_residuals(measurement: StereoMeasurement) -> StereoResiduals:
    """Compute the residuals of a stereo pair: measured disparities minus those that reference surface and sensor model predict.

    They come with predicted standard deviations, covariates and the derivatives by the pose. Points whose pixel does not see
    the reference are left out.
    """
    nominal, model = NominalPair.of(measurement), measurement.model
    u, v, measured = (_matches(measurement) if measurement.matches is None else measurement.matches).T
    real = real_pair(model.effects, measurement)
    geometry, depth = _reference(nominal, real, measurement.scene, u, v, measured)
    cell_px = raster_cell_px(u, v)
    about = _surroundings(measurement, nominal, real, geometry, depth, cell_px or 1.0)
    geometry = replace(geometry, along_row=about.gradient[:, 0], along_column=about.gradient[:, 1])
    geometry = replace(geometry, shaped=_shaped_px(measurement, geometry))
    hit = np.isfinite(geometry.disparity)
    px_per_m = nominal.geometry.f * nominal.geometry.base_m / depth**2
    covariates = _covariates(nominal, geometry, depth, about)
    mean = _systematic_error(model, geometry) + _empirical_error(model, covariates)
    even = hit & ~about.hidden & (about.edge_px < _EDGE_PX)
    whole = StereoResiduals(
        value=measured - geometry.disparity - mean,
        sigma=np.full(len(u), np.sqrt(max(model.variance, _LEAST_VARIANCE))),
        unit_m=1 / px_per_m,
        usable=even & measurement.stable,
        on_smooth_surface=even,
        pose_jacobian=apply_smoothing(model.effects, geometry, _pose_jacobian(nominal, geometry)),
        wall_xy=geometry.point[:, :2],
        covariates=covariates,
        index=np.arange(len(u)),
        geometry=geometry,
        correlated_noise=GridCorrelatedNoise(pixels=np.stack([u, v], axis=1)).with_effects(model.matching_noise),
        notes=(*measurement.notes, *_notes(_has_pixels(measurement), u, v, cell_px)),
    )
    return whole if hit.all() else whole.part(hit)


def with_matches(measurement: StereoMeasurement) -> StereoMeasurement:
    """Store the pixels and the disparities of a stereo measurement in it, to save computing them for each pose of the cameras."""
    return measurement.changed(matches=_matches(measurement))


def with_surroundings(measurement: StereoMeasurement, found: StereoResiduals) -> StereoMeasurement:
    """Store in a stereo measurement what the rock is like around the place that each pixel sees, to save tracing it again.

    Stored are depth steps and visibility from the right camera, as the residuals `found` have them. They stay valid for small
    moves of the cameras. After a large move the visibility is wrong at a few points beside edges.
    """
    edge, at = found.covariates["edge_step"], found.geometry
    gradient = np.asarray([at.along_row, at.along_column]).T
    about = Surroundings(at.point, edge, ~found.on_smooth_surface & (edge < _EDGE_PX), gradient)
    everywhere = Surroundings.nowhere(len(measurement.cloud.points))
    return measurement.changed(surroundings=everywhere.changed(found.index, about))


def with_shaped_disparities(measurement: StereoMeasurement, found: StereoResiduals) -> StereoMeasurement:
    """Store in a stereo measurement what effects on neighbouring pixels change, px of disparity, to save computing it again.

    Such effects are edge fattening, smoothing and filled occlusions. What is stored stays valid while each pixel sees the same
    place to a small part of the filter's width. found: residuals of the measurement, with these effects in the model.
    """
    shaped = np.zeros(len(measurement.cloud.points))
    shaped[found.index] = found.geometry.shaped
    return measurement.changed(shaped_px=shaped)


def _has_pixels(measurement: StereoMeasurement) -> bool:
    """Tell whether the points come with their pixels."""
    return "pixel_x" in measurement.cloud.extra and "pixel_y" in measurement.cloud.extra


def _matches(measurement: StereoMeasurement) -> FloatArray:
    """(n, 3) column and row of each point in the left image, and its disparity, px."""
    points, nominal = measurement.cloud.points, NominalPair.of(measurement)
    left, right = nominal.pair.left, nominal.pair.right
    if _has_pixels(measurement):
        u, v = (np.asarray(measurement.cloud.extra[key], dtype=np.float64) for key in ("pixel_x", "pixel_y"))
        points = move_onto_rays(left, points, u, v)
    else:
        u, v = project(left, points)
    return np.stack([u, v, nominal.disparity(project(left, points), project(right, points))], axis=1)


def _notes(given: bool, u: FloatArray, v: FloatArray, cell_px: float | None) -> tuple[str, ...]:
    """Notes that name the candidates which were left out. `given`: whether the pixels were recorded."""
    large = cell_px is not None and raster_cell_count(u, v, cell_px) > MOST_CELLS
    absent = {
        "no pixel_x, pixel_y: pixels were computed by projecting the points": not given,
        "pixels on no raster: edge_fattening, smoothing and occlusion_fill were not tested": cell_px is None,
        f"a raster of more than {MOST_CELLS:,} cells: edge_fattening, smoothing and occlusion_fill were not tested": large,
        "no images: texture_noise was not tested": True,
    }
    return tuple(note for note, true in absent.items() if true)


def _reference(
    nominal: NominalPair, real: CameraPair, scene: RayCaster, u: FloatArray, v: FloatArray, measured: FloatArray
) -> tuple[PixelGeometry, FloatArray]:
    """What the pixels of the `real` cameras see: their geometry on the reference, and the depth (n,), m."""
    left = real.left
    ray = pixel_rays(left, u, v)
    distance, face = scene.cast(left.position, ray)
    point = left.position + distance[:, None] * ray
    right = project(real.right, point)
    geometry = PixelGeometry(
        u=u,
        v=v,
        v_right=right[1],
        disparity=nominal.disparity((u, v), right),
        found=measured,
        point=point,
        normal=scene.mesh.normals[np.maximum(face, 0)],
        radius=np.hypot(u - left.width / 2, v - left.height / 2),
        tangent=nominal.tangent(u, v),
        infinity=np.full(len(u), nominal.geometry.offset),
        shaped=np.zeros(len(u)),
    )
    return geometry, distance


def _surroundings(
    measurement: StereoMeasurement,
    nominal: NominalPair,
    real: CameraPair,
    geometry: PixelGeometry,
    depth: FloatArray,
    cell_px: float,
) -> Surroundings:
    """Use the stored surroundings, and detect those of pixels that now see other places. cell_px: spacing of the pixels."""
    known = measurement.surroundings or Surroundings.nowhere(len(geometry))
    away_px = nominal.geometry.f * np.linalg.norm(geometry.point - known.point, axis=1) / depth
    rows = np.flatnonzero(np.isfinite(depth) & ~(away_px < _STAYS_PX))
    if not len(rows):
        return known
    moved = geometry if len(rows) == len(geometry) else geometry.part(rows)
    edge = _edge_px(nominal, real.left, measurement.scene, moved)
    hidden = is_hidden(measurement.scene, real.right.position, moved.point)
    gradient = _gradient(nominal, real, measurement.scene, moved, cell_px)
    return known.changed(rows, Surroundings(moved.point, edge, hidden, gradient))


def _gradient(nominal: NominalPair, real: CameraPair, scene: RayCaster, geometry: PixelGeometry, step: float) -> FloatArray:
    """(n, 2) change of the reference's disparity along the row and the column, px per px, between cells `step` px away.

    A cell that sees nothing is left out: then the difference is one-sided, or 0 if both are missing.
    """
    u, v = _four_neighbours(geometry, step)
    disparity = nominal.surface_disparity(scene, u.ravel(), v.ravel(), real).reshape(u.shape)
    right, left, below, above = (disparity - geometry.disparity[:, None]).T
    sides = np.stack([[right, -left], [below, -above]]) / step
    known = np.isfinite(sides)
    return (np.where(known, sides, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)).T


def _four_neighbours(geometry: PixelGeometry, step: float) -> tuple[FloatArray, FloatArray]:
    """(n, 4) columns and rows of the pixels `step` px to the right, to the left, below and above."""
    columns, rows = step * np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    return np.add.outer(geometry.u, columns), np.add.outer(geometry.v, rows)


def _edge_px(nominal: NominalPair, left: Camera, scene: RayCaster, geometry: PixelGeometry) -> FloatArray:
    """(n,) largest deviation of the reference from its tangent plane at four neighbouring pixels, px of disparity."""
    height = np.einsum("ni,ni->n", geometry.point - left.position, geometry.normal)
    beside = _four_neighbours(geometry, _PROBE_PX)
    step = nominal.geometry.f * nominal.geometry.base_m * steps_from_planes(scene, left, *beside, height, geometry.normal)
    return np.asarray(np.fmin(np.abs(step), _MOST_EDGE_PX).max(axis=1))


def _pose_jacobian(nominal: NominalPair, geometry: PixelGeometry) -> FloatArray:
    """(n, 6) derivatives of the disparity by a shift (m) and a rotation (rad) of both cameras about the left one, wall frame."""
    base, *columns = predict_disparities(nominal, [nominal.pair, *moved_pairs(nominal.pair, _NUDGE)], geometry)
    return np.stack([(column - base) / _NUDGE for column in columns], axis=1)


def _systematic_error(model: StereoModel, geometry: PixelGeometry) -> FloatArray:
    """(n,) systematic disparity error by the effects of the model outside the cameras, px."""
    beside = [effect for effect in model.effects if not effect.empirical and not isinstance(effect, CameraEffect | RasterEffect)]
    found = np.asarray(sum((effect.mean(geometry) for effect in beside), np.zeros(len(geometry))))
    return found + geometry.shaped


def _shaped_px(measurement: StereoMeasurement, geometry: PixelGeometry) -> FloatArray:
    """(n,) disparity that the model's effects on neighbouring pixels add, px."""
    shapes = [effect for effect in measurement.model.effects if isinstance(effect, RasterEffect)]
    if not shapes:
        return np.zeros(len(geometry))
    if measurement.shaped_px is not None:
        return measurement.shaped_px
    raster = DisparityRaster.of(measurement, geometry)
    return np.zeros(len(geometry)) if raster is None else raster.added_by(shapes, geometry.disparity)


def _empirical_error(model: StereoModel, covariates: dict[str, FloatArray]) -> FloatArray:
    """(n,) disparity that the empirical terms of the model add, px (see DisparityEmpirical)."""
    total = np.zeros(len(covariates["depth"]))
    for effect in model.effects:
        if isinstance(effect, DisparityEmpirical):
            x, y = (covariates[name] for name in (effect.covariate, effect.second or effect.covariate))
            total += interpolate_on_host(x, y, effect.along, effect.across, effect.values_px)
    return total


def _covariates(nominal: NominalPair, geometry: PixelGeometry, depth: FloatArray, about: Surroundings) -> dict[str, FloatArray]:
    """The covariates of a disparity, by name."""
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
