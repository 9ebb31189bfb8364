"""Simulate the error of a reference surface made of points: it adds to the differences, but is not noise of the instrument."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.formats.measurements.measurement import Measurement, TlsMeasurement
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, barycentric
from scene.ray_casting.raycast import RayCaster

_SAMPLE, _REPEATED = 5_000, 0.85
"""Points whose place in their triangle is looked at, and the median of their largest barycentric weight above which they lie at
vertices; it is about 0.6 where points lie anywhere.
"""


@dataclass(frozen=True)
class ReferenceError:
    """Random error of a reference surface that is a mesh of measured points; it adds to the differences from the surface.

    Attributes
    ----------
    sigma_m : Standard deviation of a vertex's error along the ray from the sensor, m.
    shared : Whether errors are shared within a triangle. True: a vertex has one error, and the surface between three
        vertices interpolates theirs, as if the vertices are noisy. False: each compared point has an error of its own, as
        if the mesh misses relief of the rock between its vertices.
    repeated : Whether the points lie in the directions of the vertices, as where later scans repeat those of the reference. A
        point then has the error of the nearest vertex.
    eye : (3,) position of the sensor, wall frame, m.
    """

    sigma_m: float
    shared: bool
    eye: FloatArray
    repeated: bool = False

    @classmethod
    def of(cls, measurement: Measurement) -> ReferenceError | None:
        """Return the error of the reference surface of a measurement, for a calibration to simulate.

        Returns None if it is unknown or zero, or the measurement is not of a laser scanner.
        """
        if not isinstance(measurement, TlsMeasurement) or not measurement.reference_error_m:
            return None
        return cls(
            measurement.reference_error_m, not measurement.error_is_relief, measurement.viewpoint, _at_vertices(measurement)
        )

    def moved(self, points: FloatArray, wall: RayCaster, random: KeyedRandom) -> FloatArray:
        """Shift points along their rays so that their distances from the reference surface contain its simulated errors.

        The surface errs by sum(w e) at a point, where e are the errors of the three vertices around it and w the point's
        barycentric weights. The point is shifted by the opposite amount, so that its distance changes as that from the
        erroneous surface would.

        Parameters
        ----------
        points : (n, 3) points, wall frame, m; NaN stays NaN.
        wall : The reference surface.
        random : Source of the vertex errors.

        Returns
        -------
        (n, 3) shifted points, wall frame, m.
        """
        ray = points - self.eye
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        distance, face = wall.cast(self.eye, np.nan_to_num(ray, nan=1.0))
        corners = wall.mesh.faces[np.maximum(face, 0)]
        weight = barycentric(self.eye + distance[:, None] * ray, wall.mesh.vertices[corners])
        if self.repeated:
            weight = (weight == weight.max(axis=1, keepdims=True)).astype(np.float64)
        drawn = random.generator()
        if self.shared:
            off = np.sum(weight * drawn.standard_normal(len(wall.mesh.vertices))[corners], axis=1)
        else:
            off = np.linalg.norm(weight, axis=1) * drawn.standard_normal(len(points))
        return points - np.where(face >= 0, self.sigma_m * off, 0.0)[:, None] * ray


def _at_vertices(measurement: TlsMeasurement) -> bool:
    """Return whether most points of a measurement lie in the directions of the reference's vertices."""
    points = measurement.cloud.points[:: max(len(measurement.cloud.points) // _SAMPLE, 1)]
    ray = points - measurement.viewpoint
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    distance, face = measurement.scene.cast(measurement.viewpoint, ray)
    hit = face >= 0
    corners = measurement.reference.vertices[measurement.reference.faces[face[hit]]]
    weight = barycentric(measurement.viewpoint + distance[hit, None] * ray[hit], corners)
    return bool(hit.any() and np.median(weight.max(axis=1)) > _REPEATED)
