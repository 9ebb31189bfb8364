"""What the error of a reference that is made of points adds to differences from it, which is no noise of the instrument."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.formats.measurements.measurement import Measurement, TlsMeasurement
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, barycentric
from scene.ray_casting.raycast import RayCaster


@dataclass(frozen=True)
class ReferenceError:
    """sigma_m: standard deviation of each vertex along the sensor's rays; shared: whether points between the same vertices share
    their errors, as they do of noise, not of relief between the vertices; eye: (3,) the sensor's place, wall frame, m."""

    sigma_m: float
    shared: bool
    eye: FloatArray

    @classmethod
    def of(cls, measurement: Measurement) -> ReferenceError | None:
        """Of a measurement whose reference is known to have one."""
        if not isinstance(measurement, TlsMeasurement) or not measurement.reference_error_m:
            return None
        planes = measurement.planes
        return cls(measurement.reference_error_m, planes is None or planes.noise_dominates, measurement.viewpoint)

    def moved(self, points: FloatArray, wall: RayCaster, random: KeyedRandom) -> FloatArray:
        """Points (n, 3) at the distances that they have from a wall whose vertices are wrong; NaN stays.

        A range to the triangle between vertices with the weights w of its place is wrong by sum w e, as for `gap`; the point goes
        along its ray by as much the other way.
        """
        ray = points - self.eye
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        distance, face = wall.cast(self.eye, np.nan_to_num(ray, nan=1.0))
        corners = wall.mesh.faces[np.maximum(face, 0)]
        weight = barycentric(self.eye + distance[:, None] * ray, wall.mesh.vertices[corners])
        drawn = random.generator()
        if self.shared:
            off = np.sum(weight * drawn.standard_normal(len(wall.mesh.vertices))[corners], axis=1)
        else:
            off = np.linalg.norm(weight, axis=1) * drawn.standard_normal(len(points))
        return points - np.where(face >= 0, self.sigma_m * off, 0.0)[:, None] * ray
