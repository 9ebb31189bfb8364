"""Pair points with the nearest points of a reference, and sum up the pairs fast and reproducibly.

Points are visited in an order in which neighbours in memory are neighbours in space. Sums are taken over blocks of fixed size
in a fixed order, so that the result is the same to the bit for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

LEAST_POINTS = 6
"""Fewest points of a cloud that is registered: one per unknown."""
_SEES = "correct the sensor's position, direction or range, for cameras also their overlap, so that it sees the wall"
"""Advice when there are too few points."""
_BLOCK = 2**14
"""Number of points per block of the sums; its arrays fit a core's cache."""
ON_A_LINE = 1e-12
"""Share of the largest variance below which the second one makes a cloud a line."""
_SCATTERED = 0.05
"""Share of a cloud's extent by which neighbours in memory may differ before sorting pays."""

Map = Callable[[Callable[[FloatArray], FloatArray], Iterable[FloatArray]], Iterable[FloatArray]]
"""`map`, or the `map` method of an executor."""


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
    tree : scipy.spatial.cKDTree
        Search tree of `points`.
    """

    origin: FloatArray
    points: FloatArray
    normals: FloatArray | None
    tree: Any

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
        from scipy.spatial import cKDTree

        points = checked_cloud(points, "reference points")
        unit = None if normals is None else _unit(normals, len(points))
        order = scan_order(points)
        origin = points.mean(axis=0)
        local = points[order] - origin
        tree = cKDTree(local, leafsize=16, balanced_tree=False)
        return cls(origin, local, None if unit is None else unit[order], tree)

    def moments(
        self, blocks: list[FloatArray], pose: RigidTransform, gate: float, normals: FloatArray | None, map_blocks: Map
    ) -> FloatArray:
        """Pair points with their nearest reference points, and sum up what the normal equations of one ICP iteration need.

        The result is the sum of u u^T over all pairs of a moved point p and a reference point q that are at most `gate`
        apart. The column vector u of a pair is, with the translation g of the pose and q's normal n:

        - with normals: ((p - g) x n, n, n . (p - q), 1), so that the result is (8, 8)
        - without normals: (p - g, q - p, 1), so that it is (7, 7)

        Its last element is the number of pairs. All coordinates are the reference's.

        Parameters
        ----------
        blocks : list of (k, 3) arrays
            The moving points, m, divided into parts that are processed separately.
        pose : RigidTransform
            Moves these points to the reference's coordinates, whose zero is the centroid of the reference.
        gate : float
            Largest distance of a pair, m.
        normals : (m, 3) array, optional
            The reference's normals, for point-to-plane distances; None for point-to-point distances.
        map_blocks : Map
            Function like the built-in `map`, which may use threads.
        """

        def block_moments(block: FloatArray) -> FloatArray:
            moved = pose.apply(block)
            distance, nearest = self.tree.query(moved, distance_upper_bound=gate)
            near = np.isfinite(distance)
            moved, nearest = moved[near], nearest[near]
            arm, offset = (moved - pose.translation).T, (moved - self.points[nearest]).T
            columns = _point_columns(arm, offset) if normals is None else _plane_columns(arm, offset, normals[nearest].T)
            return np.einsum("in,jn->ij", columns, columns)

        return np.sum(list(map_blocks(block_moments, blocks)), axis=0)


def _point_columns(arm: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the columns (7, k) from p - g and p - q, (3, k) each."""
    return np.concatenate([arm, -offset, np.ones((1, arm.shape[1]))])


def _plane_columns(arm: FloatArray, offset: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the columns (8, k) from p - g, p - q and n, (3, k) each."""
    columns = np.ones((8, arm.shape[1]))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        columns[axis] = arm[i] * normal[j] - arm[j] * normal[i]
    columns[3:6] = normal
    columns[6] = normal[0] * offset[0] + normal[1] * offset[1] + normal[2] * offset[2]
    return columns


def blocks_of(points: FloatArray) -> list[FloatArray]:
    """Divide points (n, 3) into consecutive parts of 16,384 points (the last may be shorter), to process them in threads.

    The size is fixed, so that sums do not depend on the number of threads.
    """
    return [points[start : start + _BLOCK] for start in range(0, len(points), _BLOCK)]


def scan_order(points: FloatArray) -> NDArray[np.intp] | slice:
    """Return an index that sorts points (n, 3) so that neighbours in space are neighbours in memory, for a faster search.

    Points that are already in such an order, as from a scanner's lines, keep it. Others are sorted along Morton's space-filling
    curve.
    """
    stride = max(len(points) // _BLOCK, 1)
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
    if _on_a_line(points[:: max(len(points) // _BLOCK, 1)]) and _on_a_line(
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
