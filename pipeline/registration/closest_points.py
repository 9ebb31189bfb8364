"""Prepare point clouds for a registration: check them, sort them in space, and make the search tree of the reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.registration.search_tree import SearchTree
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

LEAST_POINTS = 6
"""Fewest points of a cloud that is registered: one per unknown."""
_SEES = "correct the sensor's position, direction or range, for cameras also their overlap, so that it sees the wall"
"""Advice when there are too few points."""
_SAMPLE = 2**14
"""Number of points, at least, from which the order and the shape of a cloud are judged."""
ON_A_LINE = 1e-12
"""Share of the largest variance below which the second one makes a cloud a line."""
_SCATTERED = 0.05
"""Share of a cloud's extent by which neighbours in memory may differ before sorting pays."""


@dataclass(frozen=True)
class ReferenceSurface:
    """Hold the points of a reference surface with a search tree, to which other points are registered by ICP.

    ICP is the iterative closest point algorithm.

    Attributes
    ----------
    origin : (3,) array
        Centroid of the reference, m, which is subtracted from coordinates to keep them small.
    points : (m, 3) array
        Reference points relative to `origin`, m.
    normals : (m, 3) array, optional
        Unit normals of the points; None if they are not known.
    tree : SearchTree
        Search tree of `points`.
    """

    origin: FloatArray
    points: FloatArray
    normals: FloatArray | None
    tree: SearchTree

    @classmethod
    def build(cls, points: FloatArray, normals: FloatArray | None = None) -> ReferenceSurface:
        """Make the search tree of a reference once, for any number of registrations to it.

        Parameters
        ----------
        points : (m, 3) array
            Reference points, m.
        normals : (m, 3) array, optional
            Their normals, of any length and sign; needed only if ICP minimises point-to-plane distances.

        Raises
        ------
        InputError
            If there are fewer than six points, values that are not finite, normals of length zero, or points on one line.
        """
        points = checked_cloud(points, "reference points")
        unit = None if normals is None else _unit(normals, len(points))
        order = scan_order(points)
        origin = centroid_of(points)
        local = points[order] - origin
        return cls(origin, local, None if unit is None else unit[order], SearchTree(local))


def scan_order(points: FloatArray) -> NDArray[np.intp] | slice:
    """Return an index that sorts points (n, 3) so that neighbours in space are neighbours in memory, for a faster search.

    Points that are already in such an order, as from a scanner's lines, keep it. Others are sorted along Morton's space-filling
    curve.
    """
    stride = max(len(points) // _SAMPLE, 1)
    steps = np.abs(points[1::stride] - points[:-1:stride]).max(axis=1)
    if np.median(steps) <= _SCATTERED * np.ptp(points[::stride], axis=0).max():
        return slice(None)
    low = np.array([points[:, axis].min() for axis in range(3)])
    cell = max(float((points[:, axis] - low[axis]).max()) for axis in range(3)) / 1023
    x, y, z = (_spread_bits(((points[:, axis] - low[axis]) / cell).astype(np.uint32)) for axis in range(3))
    return np.argsort(x | y << 1 | z << 2, kind="stable")


def _spread_bits(number: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Move each of ten bits to three times its position, so that three numbers interleave to a Morton code."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        number = (number | number << np.uint32(shift)) & np.uint32(mask)
    return number


def centroid_of(points: FloatArray) -> FloatArray:
    """Return the mean (3,) of points (n, 3), by columns, which is faster and more exact than along the first axis."""
    return np.array([column.mean() for column in points.T])


def checked_cloud(points: FloatArray, name: str) -> FloatArray:
    """Check that points can determine a pose in a registration, and return them as float64.

    Parameters
    ----------
    points : (n, 3) array
        Points, m.
    name : str
        What the points are, for the error message.

    Raises
    ------
    InputError
        If the shape is wrong, or if there are fewer than six points, values that are not finite, or points on one line.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"the array has the shape {points.shape}, not (n, 3)", where=name, remedy="give one row x, y, z for each point"
        )
    if len(points) < LEAST_POINTS:
        raise InputError(f"{len(points)} points are too few", where=name, allowed=f"at least {LEAST_POINTS}", remedy=_SEES)
    finite = np.isfinite(points)
    if not finite.all():
        bad = int((~finite.all(axis=1)).sum())
        raise InputError(
            f"{bad:,} of {len(points):,} points have coordinates that are NaN or infinite",
            where=name,
            remedy="remove these points before registering",
        )
    if _on_a_line(points[:: max(len(points) // _SAMPLE, 1)]) and _on_a_line(
        points
    ):  # the sample alone may be one column of a grid
        raise InputError(
            "the points lie on one line, which determines no pose", where=name, remedy="use points that cover a surface"
        )
    return points


def _on_a_line(points: FloatArray) -> bool:
    """Return whether the points lie on a line."""
    local = points - points.mean(axis=0)
    variances = np.linalg.eigvalsh(np.einsum("ni,nj->ij", local, local))
    return not variances[1] > ON_A_LINE * variances[2]


def _unit(normals: FloatArray, count: int) -> FloatArray:
    """Normalise the normals. Raises InputError if their number or length is wrong."""
    if np.shape(normals) != (count, 3):
        raise InputError(
            f"the array has the shape {np.shape(normals)}, not ({count}, 3)",
            where="reference normals",
            remedy="give one normal x, y, z for each reference point",
        )
    length = np.sqrt(np.einsum("ni,ni->n", normals, normals))
    good = np.isfinite(length) & (length > 0)
    if not good.all():
        raise InputError(
            f"{int((~good).sum()):,} of {count:,} normals are zero, NaN or infinite",
            where="reference normals",
            remedy="remove these points and their normals",
        )
    return normals / length[:, None]
