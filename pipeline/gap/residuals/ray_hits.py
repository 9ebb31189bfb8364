"""Trace the rays of a laser scan to the reference surface, and describe the surface where they hit it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.formats.measurements.measurement import TlsMeasurement
from pipeline.gap.residuals.residuals import Rows, range_derivative, select_rows
from scene.geometry.mesh import FloatArray, IntArray, TriangleMesh, barycentric
from scene.geometry.point_planes import PointPlanes
from sensors.signal_chain.pulses import PulseGeometry

_PROBE_RAD = 6e-4
"""Angle to the neighbouring rays that detect edges, rad: about the width of a beam."""
_LEAST_COSINE = 0.05
"""Smallest cosine of the incidence angle that is divided by."""


@dataclass(frozen=True)
class RayGeometry(PulseGeometry):
    """Geometry of n laser rays with the measured ranges: the quantities on which errors of ranges depend.

    It has all fields of `PulseGeometry`. Range and incidence angle belong to the true direction of the beam, which the sensor
    model predicts. The last four fields are for a reference surface whose vertices are noisy measured points.

    Attributes
    ----------
    measured_m : (n,) measured ranges, m.
    bulge_m, corner : As `bulge` and `corner` of `RayHits`.
    weight : (n, 3) weights with which the vertices' errors enter the range: the barycentric weights at the hit, larger where the
        reference is less precise than usual; None if `corner` is None.
    plane_normal : (n, 3) normal of the plane on which a ray is assumed to hit if it is turned a little, scanner frame. None: it
        is traced to the triangles.
    """

    measured_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    bulge_m: FloatArray | None = None
    corner: IntArray | None = None
    weight: FloatArray | None = None
    plane_normal: FloatArray | None = None

    def part(self, rows: Rows) -> RayGeometry:
        """Return the geometry of a subset of the n rays."""
        return select_rows(self, rows)

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) azimuth and zenith angle, rad, scanner frame."""
        return np.stack([self.azimuth, self.zenith], axis=1)

    @property
    def departure(self) -> FloatArray:
        """(n,) measured range minus range to the reference surface, m. Predicted systematic range errors are still in it."""
        return np.asarray(self.measured_m - self.range_m)


@dataclass(frozen=True)
class RayHits:
    """Where n rays of a laser scanner hit the reference surface, and how the surface lies there.

    A reference that was itself measured consists of noisy points, and this noise tilts its triangles. It is also in the range,
    so that it would imitate errors that depend on the incidence angle. Incidence angles are then those to planes fitted to 24
    neighbouring points. If noise rather than relief dominates the scatter of the points about the planes, the normals are also
    those of the planes.

    Attributes
    ----------
    distance : (n,) range to the surface, m; infinite or NaN without a hit.
    normal : (n, 3) unit normals, wall frame: of the triangle, interpolated between its corners, or of the plane.
    cos_incidence : (n,) cosine of the incidence angle.
    curvature : (n,) largest deviation of the surface from the triangle's plane within a beam's width, m, along the ray.
    bulge : (n,) how much nearer a curved surface through the vertices lies than the triangle, m; already subtracted from
        `distance`. None if the triangles are used as they are.
    scatter : (n,) scatter of the reference's points about the planes, divided by its median; None without planes.
    corner : (n, 3) row numbers of the vertices of the triangle that each ray hits; None if the vertices have no errors of their
        own.
    weight : (n, 3) barycentric weights of these vertices at the hit; None if `corner` is None.
    """

    distance: FloatArray
    normal: FloatArray
    cos_incidence: FloatArray
    curvature: FloatArray
    bulge: FloatArray | None = None
    scatter: FloatArray | None = None
    corner: IntArray | None = None
    weight: FloatArray | None = None


def cast_rays(measurement: TlsMeasurement, axes: list[FloatArray]) -> RayHits:
    """Trace rays from a laser scanner to the reference surface.

    Parameters
    ----------
    measurement : The scan, with the scanner's pose and the reference surface.
    axes : Three arrays (n, 3), wall frame. The first has the unit directions of the rays. The second and third have the unit
        vectors in which a ray moves as its azimuth or its zenith angle grows; further rays are traced a little to these sides,
        to find edges.

    Returns
    -------
    The hits, in the order of the rays.
    """
    ray, scene, position = axes[0], measurement.scene, measurement.station[0]
    distance, face = scene.cast(position, ray)
    face = np.maximum(face, 0)
    normal = scene.mesh.normals[face]
    sides = _PROBE_RAD * np.stack([axes[1], -axes[1], axes[2], -axes[2]], axis=1)
    beside = scene.cast(position, (ray[:, None] + sides).reshape(-1, 3))[0].reshape(-1, 4)
    slopes = (range_derivative(normal, ray, axis, distance) for axis in axes[1:])
    flat = _PROBE_RAD * np.stack([sign * slope for slope in slopes for sign in (1, -1)], axis=1)
    bend = np.nan_to_num(np.abs(beside - distance[:, None] - flat), nan=np.inf)
    curvature = bend.max(axis=1, initial=0.0)
    found = RayHits(distance, normal, np.abs(np.einsum("ni,ni->n", ray, normal)), curvature)
    if measurement.planes is None and not measurement.reference_error_m:
        return found
    corner = scene.mesh.faces[face]
    weight = barycentric(position + distance[:, None] * ray, scene.mesh.vertices[corner])
    found = replace(found, corner=corner, weight=weight)
    if measurement.reference_error_m and not measurement.error_is_relief:
        found = replace(found, normal=_interpolated_normals(scene.mesh, corner, weight))
    if measurement.planes is None:
        return found
    return _smoothed_hits(found, measurement.planes, ray, corner, weight, scene.mesh.vertices[corner])


def _interpolated_normals(mesh: TriangleMesh, corner: IntArray, weight: FloatArray) -> FloatArray:
    """(n, 3) unit normals between those of the triangles' corners (n, 3), with barycentric weights (n, 3).

    The noise of a vertex tilts the triangles beside it, and so the derivative of a range by an angle would be correlated with
    the error of that range. The area-weighted normal of a vertex does not depend on its own position, because the area vectors
    of the triangles about it sum to one that depends on their outer edges alone.
    """
    normal = np.einsum("nk,nki->ni", weight, np.nan_to_num(mesh.vertex_normals())[corner])
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300))


def redirect_hits(found: RayHits, nominal: FloatArray, real: FloatArray) -> RayHits:
    """Predict where rays hit if errors of the scanner's axes turn them, on the plane that each hits in its recorded direction.

    This is used instead of tracing if the reference's points are noisy: a ray traced anew would follow the tilt of a single
    triangle, which is noise.

    Parameters
    ----------
    found : Hits of the rays in the recorded directions.
    nominal : (n, 3) unit vectors of the recorded directions, wall frame.
    real : (n, 3) unit vectors of the turned rays, wall frame.

    Returns
    -------
    The hits with the new distances and incidence angles; NaN distances for rays that graze the plane.
    """
    before, after = (np.einsum("ni,ni->n", found.normal, each) for each in (nominal, real))
    distance = found.distance * before / np.where(np.abs(after) > _LEAST_COSINE, after, np.nan)
    return replace(found, distance=distance, cos_incidence=np.abs(after))


def _smoothed_hits(
    found: RayHits, planes: PointPlanes, ray: FloatArray, corner: IntArray, weight: FloatArray, at: FloatArray
) -> RayHits:
    """Take incidence angle and scatter from planes through the points; if noise dominates, also normal and a curved surface.

    With barycentric weights b (n, 3), normals n and positions p (`at`, (n, 3 corners, 3)) at a triangle's corners, that surface
    is higher than the triangle by the sum over its sides of 4 b_i b_j d_ij, where d_ij = (n_j - n_i)·(p_j - p_i) / 8 is the
    height of an arc above its chord.
    """
    normal = planes.normal[corner]
    normal = normal * np.where(np.einsum("nki,ni->nk", normal, found.normal) < 0, -1.0, 1.0)[..., None]
    mean = normal.mean(axis=1)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    cosine = np.abs(np.einsum("ni,ni->n", ray, mean))
    scatter = planes.along(ray, corner).max(axis=1) / planes.median_scatter_m
    found = replace(found, cos_incidence=cosine, scatter=scatter)
    if not planes.noise_dominates:
        return found
    height = np.zeros(len(weight))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        arc = np.einsum("ni,ni->n", normal[:, j] - normal[:, i], at[:, j] - at[:, i]) / 8
        height += 4 * weight[:, i] * weight[:, j] * arc
    towards = np.where(np.einsum("ni,ni->n", ray, found.normal) > 0, -1.0, 1.0)
    bulge = towards * height / np.maximum(cosine, _LEAST_COSINE)
    return replace(found, distance=found.distance - bulge, normal=mean, bulge=bulge)
