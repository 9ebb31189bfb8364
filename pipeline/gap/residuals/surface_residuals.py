"""Compute the residuals of a photogrammetric cloud without cameras: its distances from the reference.

Each point is compared along the normal of the plane through the 24 vertices around the nearest one, as in M3C2 (Lague et al.
2013); the point's place is where that line hits the reference. Such a cloud's datum is unknown up to a shift, a rotation and a
scale, so its alignment has seven parameters. With N the normal of the triangle that is hit, n the direction of the line and p the
place relative to the reference's centre, a change d + w x p + s p of the datum changes the distance by N·(d + w x p + s p) /
(N·n).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from pipeline.formats.measurements.measurement import SurfaceMeasurement
from pipeline.formats.measurements.surface_datum import datum_columns
from pipeline.formats.measurements.surface_fit import near_m
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from pipeline.gap.residuals.residuals import BoolArray, Residuals
from pipeline.gap.residuals.wall_blocks import wall_blocks_by_points
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects import Effects
from sensors.effects.base import Stage, apply_stage
from sensors.effects.point_noise import PointNoise
from sensors.effects.regularization_noise import RegularizationNoise
from sensors.effects.surface_empirical import SurfaceEmpirical
from sensors.models.sensor_model import StereoModel
from sensors.signal_chain.surface_places import RecordedPoints, SurfacePlaces

NO_CAMERAS = (
    "no cameras: the effects of stereo pairs need them and were not tested; the residuals are described over the surface, "
    "without naming a cause"
)
"""Note that without cameras no effect can be named."""
NO_SCALE = "the reference has too little relief to determine the cloud's scale, which is assumed to be correct"
"""Note that the scale is not estimated."""
_START = 1e-5
"""Share of the reference's extent by which a ray starts on the other side of its point, so that it never starts on the surface.
"""
_EDGE_SIGMAS, _EDGE_SLOPE = 3.0, 0.5
"""A reference that bends by more within one point spacing counts as an edge: in sigmas, or as a share of the spacing."""
_FROM_RIM = 2.0
"""Distance from the reference's rim, in point spacings, within which it does not count as smooth."""
_JACKKNIFE_CELLS = 30.0
"""Number of wall blocks of the jackknife."""
_ROUNDING = 1e-6
"""Smallest variation of a covariate that counts as such, as a share of the reference's extent."""


@dataclass(frozen=True)
class SurfaceGeometry(SurfacePlaces):
    """Geometry of n points of a cloud without cameras: the place on the reference surface below each, and the distance to it.

    The place is described by the fields of `SurfacePlaces`.

    Attributes
    ----------
    departure : (n,) distance of each point from the reference along the normal, m, positive out of the rock.
    """

    departure: FloatArray

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) positions along and up the wall, m, which stand for those in the field of view of the unknown cameras."""
        return np.asarray(self.point[:, :2])


@dataclass(frozen=True)
class SurfaceResiduals(Residuals):
    """Residuals of a photogrammetric cloud without cameras: distances from the reference along its normal, m.

    They are positive out of the rock. The class has all attributes of `Residuals`; those that differ are described here.

    Attributes
    ----------
    pose_jacobian : (n, k) derivatives of the distances by the cloud's position, orientation and scale (its datum). There is a
        column for each of the k combinations of shift, rotation and scale that the relief of the reference can determine. It is
        evaluated at the places on the reference, because the noise of the points would bias the scale.
    datum : (7, k) shift (m), rotation (rad) and scale that belong to a unit of each of these k combinations.
    """

    sensor = "stereo"
    position_covariates = ("along", "up")
    empirical_term = SurfaceEmpirical, "values_m"
    white_noise = PointNoise, "sigma_m"
    label = "points of a surface from photographs"
    geometry: SurfaceGeometry
    datum: FloatArray = field(default_factory=lambda: np.eye(7))

    @property
    def depth_m(self) -> FloatArray:
        """(n,) change of depth per metre of distance from the reference: -1, as points further out are less deep."""
        return -self.unit_m

    @property
    def candidates(self) -> Effects:
        """Classes of the effects that may explain the residuals: only noise of the points, as all others need the cameras."""
        return (PointNoise,)


def surface_residuals(measurement: SurfaceMeasurement) -> SurfaceResiduals:
    """Compute the residuals of a cloud without cameras: the distances of its points from the reference along its normals.

    They come with predicted standard deviations, covariates and the derivatives by the cloud's position, orientation and scale.
    Points from which a line along the normal does not hit the reference nearby are left out.
    """
    points, model = measurement.cloud.points, measurement.model
    spacing = point_spacing_m(points)
    geometry, triangle, across = _hits_along_normals(measurement, points)
    index = np.flatnonzero(np.isfinite(geometry.departure))
    geometry, triangle, across = geometry.part(index), triangle[index], across[index]
    sigma = predicted_sigma(model, geometry)
    mean = sum((effect.mean(geometry) for effect in model.of_points()), np.zeros(len(index)))
    bend = _bend(measurement, geometry.point, triangle, geometry.normal, spacing)
    even = bend < np.maximum(_EDGE_SIGMAS * sigma, _EDGE_SLOPE * spacing)
    if len(rim := measurement.shape.rim):
        distance = cKDTree(measurement.reference.vertices[rim]).query(geometry.point, workers=-1)[0]
        even &= distance > _FROM_RIM * spacing
    return SurfaceResiduals(
        value=geometry.departure - mean,
        sigma=sigma,
        unit_m=np.ones(len(index)),
        usable=even & measurement.stable[index],
        on_smooth_surface=even,
        pose_jacobian=-datum_columns(geometry.point - measurement.centre, triangle) @ measurement.datum / across[:, None],
        wall_xy=geometry.point[:, :2],
        covariates=_varying_covariates(geometry, measurement),
        index=index,
        geometry=geometry,
        datum=measurement.datum,
        correlated_noise=_correlated_noise(model, geometry.point[:, :2], spacing),
        notes=(*measurement.notes, NO_CAMERAS, *(() if measurement.datum[6].any() else (NO_SCALE,))),
    )


def _varying_covariates(geometry: SurfaceGeometry, measurement: SurfaceMeasurement) -> dict[str, FloatArray]:
    """The covariates that vary by more than rounding errors."""
    extent = float(np.linalg.norm(np.ptp(measurement.reference.bounds, axis=0)))
    return {
        name: values
        for name, values in geometry.covariates.items()
        if name in SurfaceResiduals.position_covariates or (len(values) and float(np.ptp(values)) > _ROUNDING * extent)
    }


def point_spacing_m(points: FloatArray) -> float:
    """Return the median distance from a point of a cloud to its nearest neighbour, m, from a sample of about 2000 points.

    points: (n, 3), m. With fewer than two points the result is 0.
    """
    if len(points) < 2:
        return 0.0
    some = points[:: max(len(points) // 2000, 1)]
    return float(np.median(cKDTree(points).query(some, 2)[0][:, 1]))


def _hits_along_normals(measurement: SurfaceMeasurement, points: FloatArray) -> tuple[SurfaceGeometry, FloatArray, FloatArray]:
    """Find the nearest place where each point's line hits the reference.

    Returns the geometry (NaN where nothing is hit as near as a point of the surface may be), the normals (n, 3) of the
    triangles, and the cosines (n,) between these normals and the lines.
    """
    shape, scene = measurement.shape, measurement.scene
    vertex = shape.nearest(points)[1]
    normal = shape.normals(vertex)
    start = _START * float(np.linalg.norm(np.ptp(measurement.reference.bounds, axis=0)))
    down, face_below = scene.cast(points + start * normal, -normal)
    up, face_above = scene.cast(points - start * normal, normal)
    down, up = np.nan_to_num(down - start, nan=np.inf), np.nan_to_num(up - start, nan=np.inf)
    above = np.abs(down) <= np.abs(up)
    distance, face = np.where(above, down, -up), np.where(above, face_below, face_above)
    face = np.maximum(face, 0)
    triangle = scene.mesh.face_normals(face)
    across = np.einsum("ni,ni->n", triangle, normal)
    met = (np.abs(distance) < near_m(measurement.reference)) & (across > 0.1)
    distance = np.where(met, distance, np.nan)
    corners = scene.mesh.faces[face].astype(np.int64)
    places = shape.at(points - distance[:, None] * normal, corners)
    return SurfaceGeometry(**vars(places), departure=distance), triangle, np.where(met, across, 1.0)


def _bend(
    measurement: SurfaceMeasurement, point: FloatArray, triangle: FloatArray, normal: FloatArray, spacing: float
) -> FloatArray:
    """(n,) largest deviation of the reference from the hit triangle's plane at four places one point spacing away, m."""
    first = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second, bend = np.cross(normal, first), np.zeros(len(point))
    for aside in (first, -first, second, -second):
        start = point + spacing * aside + 5 * spacing * normal
        distance = measurement.scene.cast(start, -normal)[0]
        flat = np.einsum("ni,ni->n", triangle, start - point) / np.einsum("ni,ni->n", triangle, normal)
        bend = np.maximum(bend, np.nan_to_num(np.abs(distance - flat), nan=np.inf))
    return bend


def _correlated_noise(model: StereoModel, at: FloatArray, spacing: float) -> GridCorrelatedNoise:
    """The grid-correlated noise of the model. Positions and node spacings are given in point spacings instead of pixels."""
    noise = [effect for effect in model.of_points() if isinstance(effect, PointNoise) and effect.shared_sigma_m > 0]
    nodes = tuple(RegularizationNoise(sigma_px=effect.shared_sigma_m, step_px=effect.shared_step_m / spacing) for effect in noise)
    return GridCorrelatedNoise(nodes, np.nan_to_num(at / spacing)) if nodes else GridCorrelatedNoise()


def simulate_distances(model: StereoModel, residuals: SurfaceResiduals, random: KeyedRandom) -> FloatArray:
    """Simulate the distances (n,), m, of a cloud's points from the reference under a sensor model, positive out of the rock.

    residuals: residuals of the n points, with the place on the reference below each. random: source of the random numbers.
    """
    start = RecordedPoints(residuals.geometry, np.zeros(len(residuals)))
    return apply_stage(model.of_points(), Stage.POINT, start, random).above


def predicted_sigma(model: StereoModel, places: SurfaceGeometry) -> FloatArray:
    """Return the standard deviations (n,), m, of n points' distances from the reference that a sensor model predicts."""
    return np.sqrt(sum((effect.variance(places) for effect in model.of_points()), np.zeros(len(places))))


def datum_covariance(residuals: SurfaceResiduals, value: FloatArray, rows: BoolArray) -> FloatArray:
    """Estimate the covariance (7, 7) of a cloud's shift (m), rotation (rad) and scale by a jackknife over squares of the wall.

    The wall is divided into about thirty squares. Each is left out in turn, as a whole, because errors are correlated within
    it. Without square b the datum changes by -(A - A_b)⁻¹ r_b. A is the normal matrix of the alignment; A_b and r_b are what
    the points of b contribute to the normal matrix and to the right side.

    Parameters
    ----------
    residuals : Residuals of the n points of the cloud.
    value : (n,) distances from the reference after the alignment, m.
    rows : (n,) true for points by which the cloud was aligned.
    """
    part, left = residuals.part(rows), value[rows]
    number = wall_blocks_by_points(part.wall_xy, len(left) / _JACKKNIFE_CELLS)
    columns = part.pose_jacobian / part.sigma[:, None]
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / scale
    whole = columns.T @ columns
    changes = []
    for each in np.unique(number):
        own = number == each
        matrix = whole - columns[own].T @ columns[own]
        changes.append(-np.linalg.lstsq(matrix, columns[own].T @ (left[own] / part.sigma[own]), rcond=None)[0] / scale)
    count = len(changes)
    deviations = (np.array(changes) - np.mean(changes, axis=0)) @ residuals.datum.T
    return np.asarray((count - 1) / count * deviations.T @ deviations)
