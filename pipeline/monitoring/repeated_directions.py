"""Estimate the noise of a reference scan whose directions later scans repeat, as those of a permanent scanner do.

Points in one direction lie on the same spot of the rock, so relief between the points does not show in their differences.
What the differences of two later epochs have in common is then the noise of the reference. With a single later epoch, half of
the variance is taken: both were measured alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pipeline.change.robust import nmad
from pipeline.measurement.reference import MeasuredPointNoise
from scene.geometry.mesh import FloatArray

_SAMPLE, _REPEATED = 5_000, 0.15
"""Points whose neighbours are looked for, and distance to the nearest direction of the reference, in distances of neighbouring
directions there, below which a scan repeats them; of other scans it is about 0.4.
"""
_NEIGHBOURS = 8
"""Neighbours whose mean difference is subtracted, with pose and other slow errors."""
_MOST = 300_000
"""Points of the reference that are compared."""
_LEAST = 0.1
"""Least noise of the reference, as a share of the scatter of the differences."""


def repeated_noise(reference: FloatArray, later: Sequence[FloatArray], position: FloatArray) -> MeasuredPointNoise | None:
    """Estimate the noise along the beams of a reference scan, from later scans that repeat its directions.

    Parameters
    ----------
    reference : (n, 3) points of the reference, m.
    later : Stable points (k, 3) of each later scan, registered on the reference, m.
    position : (3,) place of the scanner, same frame, m.

    Returns
    -------
    The noise; None if a later scan does not repeat the directions of the reference.
    """
    from scipy.spatial import cKDTree

    direction, distance = _polar(reference - position)
    directions = cKDTree(direction)
    spacing = float(np.median(directions.query(direction[:: max(len(direction) // _SAMPLE, 1)], [2])[0]))
    rows = np.arange(0, len(direction), max(len(direction) // _MOST, 1))
    neighbours = directions.query(direction[rows], _NEIGHBOURS + 1)[1][:, 1:]
    found = []
    for points in later:
        rays, ranges = _polar(points - position)
        apart, nearest = cKDTree(rays).query(direction)
        few = rays[:: max(len(rays) // _SAMPLE, 1)]
        if np.median(directions.query(few)[0]) >= _REPEATED * spacing:
            return None
        difference = np.where(apart < 2 * _REPEATED * spacing, ranges[nearest] - distance, np.nan)
        around = difference[neighbours]
        found.append((difference[rows] - around.mean(axis=1)) / np.sqrt(1 + 1 / _NEIGHBOURS))
    variance = _variance(found)
    if variance is None:
        return None
    sigma = float(np.sqrt(variance))
    source = "what the later epochs have in common" if len(found) > 1 else "half of the variance of the later epoch's differences"
    told = "later scans repeat its directions, so relief between its points does not show"
    return MeasuredPointNoise(sigma, f"{told}: {1e3 * sigma:.2g} mm is used as the error of each point, from {source}")


def _polar(rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit directions (n, 3) and lengths (n,) of rays (n, 3)."""
    length = np.linalg.norm(rays, axis=1)
    return rays / np.maximum(length, 1e-9)[:, None], length


def _variance(differences: Sequence[FloatArray]) -> float | None:
    """Return the variance of the reference, m^2, from the differences (n,) of each later epoch; None with too few of them.

    The covariance of two epochs is that of Gnanadesikan and Kettenring (1972, Robust estimates, residuals, and outlier detection
    with multiresponse data): (NMAD(x + y)^2 - NMAD(x - y)^2) / 4.
    """
    known = [each[np.isfinite(each)] for each in differences]
    if min(map(len, known)) < _NEIGHBOURS:
        return None
    whole = float(np.mean([nmad(each) ** 2 for each in known]))
    if len(differences) == 1:
        return whole / 2
    covariances = []
    for one, other in pairwise(differences):
        both = np.isfinite(one) & np.isfinite(other)
        if both.any():
            covariances.append((nmad((one + other)[both]) ** 2 - nmad((one - other)[both]) ** 2) / 4)
    return max(float(np.mean(covariances)), _LEAST**2 * whole) if covariances else None
