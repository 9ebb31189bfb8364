"""Distances of a cloud from the reference, for a cloud out of photographs whose cameras are not known.

Each point is compared along the normal of the plane through the 24 vertices around the nearest one, as M3C2 does (Lague et al.
2013): where that line meets the reference is the point's place. A cloud's datum has a shift, a turn and a scale, so that the
registration has seven values. With N the normal of the triangle that is met, n the line's direction and p that place less the
reference's middle, a move d + w x p + s p of the cloud changes its distance by N.(d + w x p + s p) / (N.n).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.formats.measurements.measurement import SurfaceMeasurement
from pipeline.formats.measurements.surface_datum import datum_columns
from pipeline.formats.measurements.surface_fit import near_m
from pipeline.gap.residuals.correlated_noise import GridCorrelatedNoise
from pipeline.gap.residuals.residuals import BoolArray, Residuals, Rows
from pipeline.gap.residuals.wall_blocks import wall_block_numbers
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
    "no cameras: every effect of the catalogue of stereo pairs needs them, and none was tried; what is left is described over "
    "the surface, without a name for its cause"
)
NO_SCALE = "the reference has too little relief to tell the cloud's scale, which is taken as right"
_START = 1e-5
"""Share of the reference's extent by which rays start on the other side of a point, so that none starts on the surface."""
_EDGE_SIGMAS, _EDGE_SLOPE = 3.0, 0.5
"""A reference that bends by more within a spacing of the points counts as an edge: sigmas, or so much of the spacing."""
_FROM_RIM = 2.0
"""Spacings of the points from the reference's rim within which it is not smooth."""
_JACKKNIFE_CELLS = 30.0
_ROUNDING = 1e-6
"""Share of the reference's extent by which a covariate must differ."""


@dataclass(frozen=True)
class SurfaceGeometry(SurfacePlaces):
    """Places on the reference, and how far above it the points were found (n,), m."""

    departure: FloatArray

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) along the wall and up it, m."""
        return np.asarray(self.point[:, :2])

    def part(self, rows: Rows) -> SurfaceGeometry:
        """The same of some of the points."""
        return super().part(rows)


@dataclass(frozen=True)
class SurfaceResiduals(Residuals):
    """Distances along the normal, m, positive out of the rock.

    pose: (n, k) by the parts of the datum that the reference tells; datum: (7, k) these in shift (m), turn (rad) and stretch. The
    places of the reference make the slopes, not the points, whose noise would be in the stretch.
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
        """(n,) -1: a point above the surface lies less deep."""
        return -self.unit_m

    @property
    def candidates(self) -> Effects:
        """No effect of the catalogue: noise in metres alone."""
        return (PointNoise,)


def surface_residuals(measurement: SurfaceMeasurement) -> SurfaceResiduals:
    """Distances with their predicted spread and covariates; points whose line misses the reference nearby are left out."""
    points, model = measurement.cloud.points, measurement.model
    spacing = point_spacing_m(points)
    geometry, triangle, across = _met(measurement, points)
    sigma = np.sqrt(sum((effect.variance(geometry) for effect in model.of_points()), np.zeros(len(points))))
    mean = sum((effect.mean(geometry) for effect in model.of_points()), np.zeros(len(points)))
    hit = np.isfinite(geometry.departure)
    bend = _bend(measurement, geometry.point, triangle, geometry.normal, spacing)
    even = hit & (bend < np.maximum(_EDGE_SIGMAS * sigma, _EDGE_SLOPE * spacing))
    even &= _rim_distance(measurement, geometry.point) > _FROM_RIM * spacing
    whole = SurfaceResiduals(
        value=geometry.departure - mean,
        sigma=sigma,
        unit_m=np.ones(len(points)),
        usable=even & measurement.stable,
        on_smooth_surface=even,
        pose_jacobian=-datum_columns(geometry.point - measurement.centre, triangle) @ measurement.datum / across[:, None],
        wall_xy=geometry.point[:, :2],
        covariates=_varying(geometry, hit, measurement),
        index=np.arange(len(points)),
        geometry=geometry,
        datum=measurement.datum,
        correlated_noise=_shared(model, geometry.point[:, :2], spacing),
        notes=(*measurement.notes, NO_CAMERAS, *(() if measurement.datum[6].any() else (NO_SCALE,))),
    )
    return whole.part(hit)


def _varying(geometry: SurfaceGeometry, hit: BoolArray, measurement: SurfaceMeasurement) -> dict[str, FloatArray]:
    """The covariates that differ by more than rounding does."""
    extent = float(np.linalg.norm(np.ptp(measurement.reference.bounds, axis=0)))
    return {
        name: values
        for name, values in geometry.covariates.items()
        if name in SurfaceResiduals.position_covariates or (hit.any() and float(np.ptp(values[hit])) > _ROUNDING * extent)
    }


def point_spacing_m(points: FloatArray) -> float:
    """Typical distance from a point (n, 3) to the next, m."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.0
    some = points[:: max(len(points) // 2000, 1)]
    return float(np.median(cKDTree(points).query(some, 2)[0][:, 1]))


def _met(measurement: SurfaceMeasurement, points: FloatArray) -> tuple[SurfaceGeometry, FloatArray, FloatArray]:
    """Where the points' lines meet the reference, nearest; the triangle's normal there (n, 3), and the cosine (n,) between both.

    NaN where a line meets nothing as near as a point of the surface may be.
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
    known = {name: getattr(places, name) for name in ("point", "normal", "roughness", "convexity", "edge_distance")}
    return SurfaceGeometry(**known, departure=distance), triangle, np.where(met, across, 1.0)


def _bend(
    measurement: SurfaceMeasurement, point: FloatArray, triangle: FloatArray, normal: FloatArray, spacing: float
) -> FloatArray:
    """(n,) largest departure of the reference from the plane of the triangle that is met, a spacing beside it, m."""
    known = np.isfinite(point).all(axis=1)
    bend = np.full(len(point), np.inf)
    at, plane, direction = point[known], triangle[known], normal[known]
    first = np.cross(direction, np.where(np.abs(direction[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second, found = np.cross(direction, first), np.zeros(len(at))
    lift = 5 * spacing
    for aside in (first, -first, second, -second):
        beside = at + spacing * aside
        distance = measurement.scene.cast(beside + lift * direction, -direction)[0]
        flat = np.einsum("ni,ni->n", plane, beside + lift * direction - at) / np.einsum("ni,ni->n", plane, direction)
        found = np.maximum(found, np.nan_to_num(np.abs(distance - flat), nan=np.inf))
    bend[known] = found
    return bend


def _rim_distance(measurement: SurfaceMeasurement, point: FloatArray) -> FloatArray:
    """(n,) m from the reference's open border; infinite where it has none."""
    from scipy.spatial import cKDTree

    rim = measurement.shape.rim
    known = np.isfinite(point).all(axis=1)
    distance = np.where(known, np.inf, 0.0)
    if len(rim):
        distance[known] = cKDTree(measurement.reference.vertices[rim]).query(point[known], workers=-1)[0]
    return distance


def _shared(model: StereoModel, at: FloatArray, spacing: float) -> GridCorrelatedNoise:
    """What neighbours share of the model's noise. Places are counted in spacings, as pixels are: values on nodes know no unit."""
    noise = [effect for effect in model.of_points() if isinstance(effect, PointNoise) and effect.shared_sigma_m > 0]
    nodes = tuple(RegularizationNoise(sigma_px=effect.shared_sigma_m, step_px=effect.shared_step_m / spacing) for effect in noise)
    return GridCorrelatedNoise(nodes, np.nan_to_num(at / spacing)) if nodes else GridCorrelatedNoise()


def simulate_distances(model: StereoModel, residuals: SurfaceResiduals, random: KeyedRandom) -> FloatArray:
    """(n,) m above the reference that the model says of the residuals' points."""
    start = RecordedPoints(residuals.geometry, np.zeros(len(residuals)))
    return apply_stage(model.of_points(), Stage.POINT, start, random).above


def predicted_sigma(model: StereoModel, residuals: SurfaceResiduals) -> FloatArray:
    """(n,) spread that a model predicts, m."""
    return np.sqrt(sum((effect.variance(residuals.geometry) for effect in model.of_points()), np.zeros(len(residuals))))


def datum_covariance(residuals: SurfaceResiduals, value: FloatArray, rows: BoolArray) -> FloatArray:
    """(7, 7) covariance of shift, turn and stretch: the jackknife over blocks of the wall, which share their errors.

    value: (n,) residuals with the registration taken off; rows: (n,) those by which it was made. Without a block b the values
    change by -(A - A_b)^-1 r_b, A and r being the normal equations' matrix and right side.
    """
    part, left = residuals.part(rows), value[rows]
    extent = np.ptp(part.wall_xy, axis=0)
    block = wall_block_numbers(part.wall_xy, float(np.sqrt(np.prod(extent) / _JACKKNIFE_CELLS)) / 3)
    _, number = np.unique(block, return_inverse=True)
    scale = np.linalg.norm(part.pose_jacobian / part.sigma[:, None], axis=0)
    columns = part.pose_jacobian / part.sigma[:, None] / scale
    whole = columns.T @ columns
    changes = []
    for each in range(int(number.max()) + 1):
        own = number == each
        matrix = whole - columns[own].T @ columns[own]
        changes.append(-np.linalg.lstsq(matrix, columns[own].T @ (left[own] / part.sigma[own]), rcond=None)[0] / scale)
    count = len(changes)
    spread = (np.array(changes) - np.mean(changes, axis=0)) @ residuals.datum.T
    return np.asarray((count - 1) / count * spread.T @ spread)
