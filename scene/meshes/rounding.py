"""Detect coordinates that were rounded before they were written to a file, and refuse those that spoil a surface.

Single precision (float32) holds 24 bits: a northing of 5,000,000 m is rounded to 0.5 m, an easting of 500,000 m to 0.03 m.
Some exports also write few decimals. Rounding is visible in the values whatever their type is now: all coordinates along an
axis are multiples of one step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh

_SHARE_OF_EDGE = 1 / 20
"""A step above this share of the edge length tilts triangles by more than a degree (an error of step / sqrt(12) at both ends)."""
_HARMLESS_M, _HARMFUL_M = 1e-3, 5e-3
"""Rounding to 1 mm has a standard deviation of 0.3 mm, a tenth of a scanner's range noise (3 mm); to 5 mm 1.4 mm, half of it."""
_POWERS_OF_2 = 2.0 ** np.arange(-24, 13)
_STEPS = np.sort(np.concatenate([_POWERS_OF_2, 10.0 ** np.arange(-6, 4)]))[::-1]
"""Candidate steps in the file's unit, coarsest first: those of binary and of decimal rounding."""
_CLOSE = 1e-4
"""Tolerance, as a share of the step, within which a value counts as a multiple."""
_FEWEST_LEVELS = 16
"""An axis with fewer distinct values may belong to a built shape (a box, a step) and does not count as rounded, unless all axes
use the last bit of single precision.
"""
_REGULAR = 0.95
"""Share of triangles spanning one grid cell above which an axis is that of a regular grid."""
_SAMPLE = 512
"""Number of values that a step is tried on first."""
_FACES = 100_000
"""Number of triangles from which the edge length is taken."""


@dataclass(frozen=True)
class RoundedAxis:
    """A coordinate axis along which the coordinates of a mesh or point cloud were rounded, and to what.

    Attributes
    ----------
    axis : str
        "x", "y" or "z".
    step_m : float
        All coordinates are multiples of this step, m.
    binary : bool
        Whether the step is a power of 2, as single precision (float32) leaves it.
    float32 : bool
        Whether storing the present coordinates in single precision explains the step.
    largest_m : float
        Largest absolute coordinate, m.
    """

    axis: str
    step_m: float
    binary: bool
    float32: bool
    largest_m: float

    def __str__(self) -> str:
        why = f" (single precision of coordinates up to {self.largest_m:,.0f} m)" if self.float32 else ""
        return f"{self.axis} in steps of {self.step_m:.3g} m{why}"


def rounding_step(values: FloatArray) -> float:
    """Find the step to which numbers (n,) were rounded: the coarsest power of 2 or of 10 that divides all their differences.

    Returns 0 if there is none.
    """
    apart = values - values[0]
    noise = 8 * np.finfo(float).eps * float(np.abs(values).max())
    few = apart[:: max(len(apart) // _SAMPLE, 1)]
    for step in _STEPS[(noise < _CLOSE * _STEPS) & (np.ptp(values) >= _STEPS)]:
        if _are_multiples(few, step) and _are_multiples(apart, step):
            return float(step)
    return 0.0


def check_rounding(mesh: TriangleMesh, metres: float, where: str) -> tuple[str, ...]:
    """Check whether the coordinates of an imported mesh were rounded, for example by a file format in single precision.

    Parameters
    ----------
    mesh : TriangleMesh
        The mesh as read, in the file's unit.
    metres : float
        Metres per unit of the mesh's coordinates.
    where : str
        Name of the file in error messages.

    Returns
    -------
    tuple of str
        Notes on rounding that does no harm.

    Raises
    ------
    InputError
        If the rounding spoils the surface: its step exceeds 1 mm and also a twentieth of the median edge length or, with single
        precision, 5 mm.
    """
    corners = mesh.vertices[mesh.faces[:: max(len(mesh.faces) // _FACES, 1)]]
    sides = np.abs(corners - np.roll(corners, 1, axis=1))
    edge = float(np.median(np.linalg.norm(sides, axis=2))) * metres
    return check_steps(rounded_axes(mesh.vertices, metres, sides), edge, where, "the triangles' edges are")


def check_steps(rounded: Sequence[RoundedAxis], spacing_m: float, where: str, spacing: str) -> tuple[str, ...]:
    """Refuse coordinates whose rounding spoils a surface.

    Parameters
    ----------
    rounded : sequence of RoundedAxis
        The axes that were rounded.
    spacing_m : float
        Median distance between neighbouring vertices or points, m.
    where : str
        Name of the file in error messages.
    spacing : str
        Subject and verb of the sentence that states `spacing_m`, such as "the triangles' edges are".

    Returns
    -------
    tuple of str
        Notes on rounding that does no harm but should be mentioned.

    Raises
    ------
    InputError
        If a step exceeds 1 mm and also a twentieth of the spacing or, if it stems from single precision, 5 mm.
    """
    limit = max(_HARMLESS_M, _SHARE_OF_EDGE * spacing_m)
    limits = {each.axis: min(limit, _HARMFUL_M) if each.binary else limit for each in rounded}
    axes_and_steps = [each for each in rounded if each.step_m > limits[each.axis]]
    if axes_and_steps:
        raise InputError(
            f"the coordinates were rounded: {', '.join(map(str, axes_and_steps))}; {spacing} {spacing_m:.3g} m (median)",
            where=where,
            allowed=f"steps of up to {limits[axes_and_steps[0].axis]:.2g} m",
            remedy="export the mesh again in double precision, or subtract an offset from the coordinates before the export",
        )
    return tuple(f"the coordinates are rounded, {each}" for each in rounded if each.step_m > _HARMFUL_M)


def rounded_axes(points: FloatArray, metres: float = 1.0, sides: FloatArray | None = None) -> list[RoundedAxis]:
    """Find the axes whose coordinates were rounded to more than 1 mm. The axes of a regular grid do not count.

    Parameters
    ----------
    points : (n, 3) array
        Coordinates.
    metres : float
        Metres per unit of the coordinates.
    sides : (m, 3, 3) array, optional
        Absolute coordinate differences along the sides of the m triangles between the points; None for a cloud without
        triangles.

    Returns
    -------
    list of RoundedAxis
    """
    if not len(points):
        return []
    steps = [rounding_step(column) for column in points.T]
    largest = [float(np.abs(column).max()) for column in points.T]
    single = _are_float32(points)
    float32 = [bool(single and step <= np.spacing(np.float32(most))) for step, most in zip(steps, largest, strict=True)]
    kept = [
        RoundedAxis(name, step * metres, bool(np.isin(step, _POWERS_OF_2)), float32[axis], largest[axis] * metres)
        for axis, (name, step) in enumerate(zip("xyz", steps, strict=True))
        if step * metres > _HARMLESS_M
        and (all(float32) or len(np.unique(np.rint(points[:, axis] / step))) >= _FEWEST_LEVELS)
        and (sides is None or not _is_regular(sides[:, :, axis], step))
    ]
    return _without_rasters(kept)


def _without_rasters(rounded: list[RoundedAxis]) -> list[RoundedAxis]:
    """Return no axes if exactly two have the same step: the vertices then come from a raster with that spacing."""
    taken = len(rounded) == 2 and rounded[0].step_m == rounded[1].step_m and not all(each.float32 for each in rounded)
    return [] if taken else rounded


def _are_float32(points: FloatArray) -> bool:
    """Return whether all coordinates are exactly representable in single precision."""
    with np.errstate(over="ignore"):
        return bool(np.array_equal(points.astype(np.float32).astype(np.float64), points))


def _is_regular(sides: FloatArray, step: float) -> bool:
    """Return whether an axis belongs to a regular grid: nearly all triangles, with sides (m, 3) along it, span one cell."""
    ordered = np.sort(sides, axis=1)
    cell = np.median(ordered[:, 2])
    one = (ordered[:, 0] < _CLOSE * step) & (np.abs(ordered[:, 1:] - cell) < _CLOSE * step).all(axis=1)
    return bool(cell > 0 and np.mean(one) > _REGULAR)


def _are_multiples(apart: FloatArray, step: float) -> bool:
    """Return whether all differences are multiples of the step."""
    ratio = apart / step
    return bool(np.all(np.abs(ratio - np.rint(ratio)) < _CLOSE))
