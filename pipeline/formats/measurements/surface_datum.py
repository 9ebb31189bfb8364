"""Find which components of a cloud's datum (shift, rotation, scale) a surface determines.

A plane determines one shift and two rotations; a wall with relief determines all of them, and the scale only by its relief.
"""

from __future__ import annotations

import numpy as np

from scene.geometry.mesh import FloatArray

_SAMPLE = 5000
"""Number of places in the sample."""
_LEAST = 1e-3
"""Smallest RMS displacement normal to the surface of a fitted component, per metre that it shifts the surface, or that a rotation
or scale moves its ends. Noise of 4 mm at 500 places would leave smaller components uncertain by 0.2 m or more.
"""


def datum_columns(away: FloatArray, normal: FloatArray) -> FloatArray:
    """Return how a shift, rotation or scale of a surface moves its points along the normals, as columns of a Jacobian.

    away: (n, 3) points relative to the centre, m; normal: (n, 3) unit normals. Returns (n, 7) displacements, m, per m of shift
    (3 columns), rad of rotation (3) and unit of scale.
    """
    columns = [normal, np.cross(away, normal), np.einsum("ni,ni->n", away, normal)[:, None]]
    return np.concatenate(columns, axis=1)


def told_datum(away: FloatArray, normal: FloatArray) -> FloatArray:
    """Return which combinations of shift, rotation and scale can be determined by comparing points with a surface.

    On a plane, for example, shifts along it cannot.

    away: (n, 3) places on the surface relative to its centre, m. normal: (n, 3) unit normals there. Returns the k combinations as
    columns (7, k) of three shifts, m, three rotations, rad, and a change of scale. If all seven can be determined, this is the
    identity.
    """
    some = slice(None, None, max(len(away) // _SAMPLE, 1))
    reach = np.sqrt(np.mean(np.sum(away[some] ** 2, axis=1)))
    scale = np.array([1.0, 1.0, 1.0, *(4 * [reach])])
    columns = datum_columns(away[some], normal[some]) / scale / np.sqrt(len(away[some]))
    rigid, stretch = columns[:, :6], columns[:, 6]
    left = stretch - rigid @ np.linalg.lstsq(rigid, stretch, rcond=None)[0]
    told = 7 if np.linalg.norm(left) > _LEAST else 6
    _, sizes, rows = np.linalg.svd(columns[:, :told], full_matrices=False)
    whole = np.eye(7)[:, :told]
    return whole if sizes.min() > _LEAST else np.asarray((whole @ rows[sizes > _LEAST].T) / scale[:, None])
