"""What the rays of a scan meet on the surface as known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.formats.measurements.measurement import TlsMeasurement
from pipeline.gap.residuals.residuals import Rows, range_derivative, select_rows
from scene.geometry.mesh import FloatArray, IntArray, barycentric
from scene.geometry.point_planes import PointPlanes
from sensors.signal_chain.pulses import PulseGeometry

_PROBE_RAD = 6e-4
"""Angle to the neighbouring rays that tell edges: about the width of a beam."""
_LEAST_COSINE = 0.05


@dataclass(frozen=True)
class RayGeometry(PulseGeometry):
    """Per point what the equations look at, where the beam goes on average by the model, and the measured range (m).

    bulge_m: by how much nearer the surface lies than the triangle between its points, part of range_m; None: not at all. corner,
    weight: (n, 3) vertices of the triangle met, and what each says of the place in it; None where the vertices have no errors.
    plane_normal: (n, 3), scanner frame, of the plane along which a ray that turns goes; None: along the triangles.
    """

    measured_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    bulge_m: FloatArray | None = None
    corner: IntArray | None = None
    weight: FloatArray | None = None
    plane_normal: FloatArray | None = None

    def part(self, rows: Rows) -> RayGeometry:
        """The same of some of the points."""
        return select_rows(self, rows)

    @property
    def sensor_coordinates(self) -> FloatArray:
        """(n, 2) azimuth and zenith, rad."""
        return np.stack([self.azimuth, self.zenith], axis=1)

    @property
    def departure(self) -> FloatArray:
        """(n,) measured range less that of the reference, m."""
        return np.asarray(self.measured_m - self.range_m)


@dataclass(frozen=True)
class RayHits:
    """What n rays meet. distance: (n,), m; normal: (n, 3) of the triangle, unit; cos_incidence: (n,); curvature: (n,) the largest
    departure from the triangle's plane within a beam's width, m.

    Of a reference made of points the incidence is that to planes through 24 of them, and so is the normal where noise is most of
    their scatter: triangles lean by the noise of their corners, which is that of the distance too, so that whatever is
    proportional to a slope would seem to be there. bulge: (n,) by how much nearer the surface then lies than the triangle, part
    of the distance, m; scatter: (n,) of the points about planes, over the typical one. corner, weight: as in `RayGeometry`.
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
    """axes: the rays' directions (n, 3), unit, wall frame, and how they turn with azimuth and zenith."""
    ray, scene, position = axes[0], measurement.scene, measurement.station[0]
    distance, face = scene.cast(position, ray)
    face = np.maximum(face, 0)
    normal = scene.mesh.normals[face]
    curvature = np.zeros(len(ray))
    for axis in axes[1:]:
        flat = range_derivative(normal, ray, axis, distance)
        for step in (_PROBE_RAD, -_PROBE_RAD):
            beside = scene.cast(position, ray + step * axis)[0]
            curvature = np.maximum(curvature, np.nan_to_num(np.abs(beside - distance - step * flat), nan=np.inf))
    found = RayHits(distance, normal, np.abs(np.einsum("ni,ni->n", ray, normal)), curvature)
    if measurement.planes is None and not measurement.reference_error_m:
        return found
    corner = scene.mesh.faces[face]
    weight = barycentric(position + distance[:, None] * ray, scene.mesh.vertices[corner])
    found = replace(found, corner=corner, weight=weight)
    if measurement.planes is None:
        return found
    return _between_points(found, measurement.planes, ray, (corner, weight, scene.mesh.vertices[corner]))


def redirect_hits(found: RayHits, nominal: FloatArray, real: FloatArray) -> RayHits:
    """What rays (n, 3) meet that left in other directions `real`, along the planes that the nominal ones met: where noise is most
    of a reference's scatter, a ray that turns would go along the noise of a triangle."""
    before, after = (np.einsum("ni,ni->n", found.normal, each) for each in (nominal, real))
    distance = found.distance * before / np.where(np.abs(after) > _LEAST_COSINE, after, np.nan)
    return replace(found, distance=distance, cos_incidence=np.abs(after))


_Triangles = tuple[IntArray, FloatArray, FloatArray]
"""Of those met: their corners (n, 3), the weights of these (n, 3), and where they are (n, 3 corners, 3)."""


def _between_points(found: RayHits, planes: PointPlanes, ray: FloatArray, triangles: _Triangles) -> RayHits:
    """With planes through the points; where those are noise, in place of triangles, and the surface bent over these."""
    corner = triangles[0]
    normal = planes.normal[corner]
    normal = normal * np.where(np.einsum("nki,ni->nk", normal, found.normal) < 0, -1.0, 1.0)[..., None]
    mean = normal.mean(axis=1)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    cosine = np.abs(np.einsum("ni,ni->n", ray, mean))
    scatter = planes.along(ray, corner).max(axis=1) / planes.median_scatter_m
    found = replace(found, cos_incidence=cosine, scatter=scatter)
    if not planes.noise_dominates:
        return found
    towards = np.where(np.einsum("ni,ni->n", ray, found.normal) > 0, -1.0, 1.0)
    bulge = towards * _height(normal, triangles) / np.maximum(cosine, _LEAST_COSINE)
    return replace(found, distance=found.distance - bulge, normal=mean, bulge=bulge)


def _height(normal: FloatArray, triangles: _Triangles) -> FloatArray:
    """(n,) of a surface over its triangles whose normals at the corners are (n, 3 corners, 3).

    With barycentric coordinates b the sum over the sides of 4 b_i b_j d_ij, where d_ij = (n_j - n_i) (p_j - p_i) / 8 is the
    height of an arc over its chord.
    """
    _, weight, at = triangles
    height = np.zeros(len(weight))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        arc = np.einsum("ni,ni->n", normal[:, j] - normal[:, i], at[:, j] - at[:, i]) / 8
        height += 4 * weight[:, i] * weight[:, j] * arc
    return height
