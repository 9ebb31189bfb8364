"""What a surface tells of a cloud's datum: shift, turn and scale move it off itself, but for what its shape does not show.

A plane shows one shift and two turns, a wall with relief all of them, and the scale by its relief alone.
"""

from __future__ import annotations

import numpy as np

from scene.geometry.mesh import FloatArray

_SAMPLE = 5000
_LEAST = 1e-3
"""Root mean square of how far a surface moves off itself, below which a part of the datum is not fitted: per metre that it is
moved, or that a turn or a stretch moves its ends. Noise of 4 mm in 500 places leaves such a part known to 0.2 m at best."""


def datum_columns(away: FloatArray, normal: FloatArray) -> FloatArray:
    """(n, 7) by how much places (n, 3), m from the middle, with unit normals (n, 3) move along them by a shift (m), a turn (rad)
    and a stretch of the surface."""
    columns = [normal, np.cross(away, normal), np.einsum("ni,ni->n", away, normal)[:, None]]
    return np.concatenate(columns, axis=1)


def told_datum(away: FloatArray, normal: FloatArray) -> FloatArray:
    """(7, k) the parts of a datum that a surface tells, of its places and normals (n, 3): unit vectors of the seven values where
    it tells each of them, combinations where it does not."""
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
