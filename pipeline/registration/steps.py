"""Solve the normal equations of one iteration of ICP for the rotation and the shift of the moving points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.registration.closest_points import ON_A_LINE
from pipeline.registration.rigid import rotation_matrix
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_UNDETERMINED = 1e-6
"""Motions whose mean squared effect on the residuals, per squared metre moved, is below this share of the largest are not
estimated. A wall whose normals vary by less than 1 mrad is a plane.
"""


@dataclass(frozen=True)
class Step:
    """One step of the search: rotation (3, 3) about the centroid and shift (3,), m; mean square of the residuals after it, m2.

    residual_change_m: RMS of the change of the residuals, m; undetermined: number of motions that were not estimated.
    """

    rotation: FloatArray
    shift: FloatArray
    mean_squares: float
    residual_change_m: float
    undetermined: int = 0


def plane_step(moments: FloatArray, radius: float) -> Step:
    """Solve for the rotation vector w and the shift t that minimise point-to-plane distances, by one Gauss-Newton step.

    The rotation is scaled by the radius of the moving cloud, m (RMS distance from its centroid), so that all six unknowns are
    metres moved.
    """
    scale = np.repeat([1 / radius, 1.0], 3)
    count = moments[-1, -1]
    normal = moments[:6, :6] / count * np.outer(scale, scale)
    gradient = moments[:6, 6] / count * scale
    unknowns, undetermined = _least_norm(normal, -gradient)
    change = float(unknowns @ normal @ unknowns)
    squares = float(moments[6, 6] / count + 2 * gradient @ unknowns) + change
    rotation = rotation_matrix(unknowns[:3] / radius)
    return Step(rotation, unknowns[3:], max(squares, 0.0), float(np.sqrt(max(change, 0.0))), undetermined)


def point_step(moments: FloatArray) -> Step:
    """Compute Kabsch's rotation (determinant +1) and the corresponding shift from the pairs' p - g and d = q - p.

    Everything is expressed by M = R - I and d, which are small, so that no precision is lost where points nearly coincide.
    """
    count = moments[-1, -1]
    mean_p, mean_d = moments[:3, 6] / count, moments[3:6, 6] / count
    spread = moments[:3, :3] / count - np.outer(mean_p, mean_p)
    cross = moments[:3, 3:6] / count - np.outer(mean_p, mean_d)
    u, singular, vt = np.linalg.svd(spread + cross)
    if not singular[1] > ON_A_LINE * singular[0]:
        raise InputError(
            "all points within this distance lie on one line", where="icp.outlier_distance_threshold", remedy="raise the limit"
        )
    rotation = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    turn = rotation - np.eye(3)
    shift = mean_d - turn @ mean_p
    moved = float(np.trace(turn @ spread @ turn.T))
    squares = np.trace(moments[3:6, 3:6]) / count - mean_d @ mean_d + moved - 2 * np.trace(turn @ cross)
    return Step(rotation, shift, max(float(squares), 0.0), float(np.sqrt(max(moved + mean_d @ mean_d, 0.0))))


def _least_norm(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, int]:
    """Return the shortest least-squares solution of a symmetric system (6, 6), and how many of its directions are undetermined.

    Eigenvectors with an eigenvalue below `_UNDETERMINED` times the largest are left out (pseudo-inverse).
    """
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _UNDETERMINED * values[-1]
    inverse = np.divide(1.0, values, out=np.zeros(len(values)), where=kept)
    return vectors @ (inverse * (vectors.T @ right)), int(np.sum(~kept))
