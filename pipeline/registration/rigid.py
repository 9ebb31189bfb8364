"""Define rigid transforms of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from scene.geometry.mesh import FloatArray

_AT_ONCE = 1 << 14
"""Points that are transformed at a time; their arrays then stay in the processor's cache."""


@dataclass(frozen=True)
class RigidTransform:
    """Store a rigid transform x' = R x + t of points.

    Attributes
    ----------
    rotation : (3, 3) array
        Rotation matrix R with determinant +1.
    translation : (3,) array
        Translation t, m.
    """

    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def identity(cls) -> RigidTransform:
        """Return the rigid transform that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def about(cls, centre: FloatArray, rotation_vector: FloatArray, translation: FloatArray) -> RigidTransform:
        """Make the rigid transform that rotates about a centre and then shifts: x' = R (x - centre) + centre + t.

        Parameters
        ----------
        centre : (3,) array
            Centre of the rotation, m.
        rotation_vector : (3,) array
            Axis times angle of the rotation R, rad; counter-clockwise if the axis points to the viewer (right-handed).
        translation : (3,) array
            Shift t, m.
        """
        rotation = rotation_matrix(rotation_vector)
        return cls(rotation, centre + translation - rotation @ centre)

    def apply(self, points: FloatArray) -> FloatArray:
        """Apply the rigid transform to points (..., 3), m; NaN stays NaN."""
        every = points.reshape(-1, 3)
        moved = np.empty(every.shape)
        for start in range(0, len(every), _AT_ONCE):
            x, y, z = every[start : start + _AT_ONCE].T
            for axis, (row, shift) in enumerate(zip(self.rotation, self.translation, strict=True)):
                moved[start : start + _AT_ONCE, axis] = row[0] * x + row[1] * y + row[2] * z + shift
        return moved.reshape(points.shape)

    def apply_to_columns(self, columns: FloatArray) -> FloatArray:
        """Apply the rigid transform to the columns x, y, z (3, n) of points, m, and return those of the moved points.

        This is faster than `apply` for so few points that they stay in the processor's cache.
        """
        x, y, z = columns
        moved = np.empty(columns.shape)
        for column, row, shift in zip(moved, self.rotation, self.translation, strict=True):
            np.multiply(x, row[0], out=column)
            column += row[1] * y
            column += row[2] * z
            column += shift
        return moved

    def after(self, first: RigidTransform) -> RigidTransform:
        """Compose two rigid transforms: return the one that applies `first` and then this one."""
        return RigidTransform(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)

    def inverse(self) -> RigidTransform:
        """Return the inverse of the rigid transform."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    @property
    def rotation_vector(self) -> FloatArray:
        """Axis times angle (3,) of the rotation, rad, for an angle below pi."""
        sine = np.array([self.rotation[i, j] - self.rotation[j, i] for i, j in ((2, 1), (0, 2), (1, 0))]) / 2
        norm = float(np.linalg.norm(sine))
        angle = float(np.arctan2(norm, (np.trace(self.rotation) - 1) / 2))
        return sine * (angle / norm) if norm > 0 else sine

    def to_dict(self) -> dict[str, Any]:
        """Return the rigid transform for JSON: rotation, translation_m and rotation_vector_rad (axis times angle)."""
        return {
            "rotation": self.rotation.tolist(),
            "translation_m": self.translation.tolist(),
            "rotation_vector_rad": self.rotation_vector.tolist(),
        }


def rotation_matrix(rotation_vector: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation matrix of a rotation vector, by Rodrigues' formula I + sin(a)/a W + (1 - cos(a))/a^2 W^2.

    rotation_vector: (3,) vector w, the axis times the angle a = |w|, rad. W is its cross-product matrix.
    """
    x, y, z = rotation_vector
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(rotation_vector))
    # np.sinc(t) = sin(pi t) / (pi t) is exact at 0; (1 - cos a) / a^2 = (sin(a/2) / (a/2))^2 / 2 without cancellation.
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (skew @ skew)
