"""Coordinates that were rounded before they came here: to single precision far from the origin, or to few decimals.

Float32 holds 24 bits: a northing of 5,000,000 m is rounded to 0.5 m, an easting of 500,000 m to 0.03 m. What was rounded shows
it in its values, whatever the type that holds them now: all of an axis are multiples of one step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh

_SHARE_OF_EDGE = 1 / 20
"""A step above this share of the edges tilts triangles by more than a degree: step / sqrt(12) at both ends of an edge."""
_HARMLESS_M, _HARMFUL_M = 1e-3, 5e-3
"""Rounding by 1 mm errs by 0.3 mm, a tenth of a scanner's noise in range (3 mm); by 5 mm by 1.4 mm, half of it."""
_POWERS_OF_2 = 2.0 ** np.arange(-24, 13)
_STEPS = np.sort(np.concatenate([_POWERS_OF_2, 10.0 ** np.arange(-6, 4)]))[::-1]
"""Steps looked for, in the file's unit, from the coarsest: those of binary and of decimal rounding."""
_CLOSE = 1e-4
"""Of a step: a value this near to a multiple is one."""
_FEWEST_LEVELS = 16
"""Distinct values below which an axis may be a built shape's (a box, a step), unless all axes use single precision's last bit."""
_REGULAR = 0.95
_SAMPLE = 512
_FACES = 100_000
"""Triangles looked at."""


@dataclass(frozen=True)
class Rounded:
    """An axis of rounded coordinates.

    axis: x, y or z; step_m: all values are multiples of it; binary: the step is a power of 2, as single precision leaves it;
    float32: the values as they are come of single precision; largest_m: the largest of them.
    """

    axis: str
    step_m: float
    binary: bool
    float32: bool
    largest_m: float

    def __str__(self) -> str:
        why = f" (single precision of coordinates up to {self.largest_m:,.0f} m)" if self.float32 else ""
        return f"{self.axis} in steps of {self.step_m:.3g} m{why}"


def step_of(values: FloatArray) -> float:
    """The coarsest step, a power of 2 or of 10, that divides all differences of `values` (n,); 0 where there is none."""
    apart = values - values[0]
    noise = 8 * np.finfo(float).eps * float(np.abs(values).max())
    few = apart[:: max(len(apart) // _SAMPLE, 1)]
    for step in _STEPS[(noise < _CLOSE * _STEPS) & (np.ptp(values) >= _STEPS)]:
        if _are_multiples(few, step) and _are_multiples(apart, step):
            return float(step)
    return 0.0


def check_rounding(mesh: TriangleMesh, metres: float, where: str) -> tuple[str, ...]:
    """Notes on rounding that does no harm. mesh: in the file's unit of so many `metres`, as read.

    Raises InputError where the rounding spoils the surface: its step is above 1 mm and a twentieth of the median edge, or,
    where it comes of single precision, above 5 mm.
    """
    corners = mesh.vertices[mesh.faces[:: max(len(mesh.faces) // _FACES, 1)]]
    sides = np.abs(corners - np.roll(corners, 1, axis=1))
    edge = float(np.median(np.linalg.norm(sides, axis=2))) * metres
    return check_steps(rounded_axes(mesh.vertices, metres, sides), edge, where, "the triangles' edges are")


def check_steps(rounded: Sequence[Rounded], spacing_m: float, where: str, spacing: str) -> tuple[str, ...]:
    """Refuse coordinates whose rounding spoils a surface.

    Parameters
    ----------
    rounded : sequence of Rounded
        The axes that were rounded.
    spacing_m : float
        Median distance of neighbouring vertices or points, m.
    where : str
        What an error calls the file.
    spacing : str
        Subject and verb of a sentence that tells `spacing_m`.

    Returns
    -------
    tuple of str
        Notes on rounding that does no harm and is worth a word.

    Raises
    ------
    InputError
        Where a step is above 1 mm and a twentieth of the spacing or, if it comes of single precision, above 5 mm.
    """
    limit = max(_HARMLESS_M, _SHARE_OF_EDGE * spacing_m)
    limits = {each.axis: min(limit, _HARMFUL_M) if each.binary else limit for each in rounded}
    harmful = [each for each in rounded if each.step_m > limits[each.axis]]
    if harmful:
        raise InputError(
            f"the coordinates were rounded, {', '.join(map(str, harmful))}; {spacing} {spacing_m:.3g} m (median)",
            where=where,
            allowed=f"steps of up to {limits[harmful[0].axis]:.2g} m",
            remedy="export it anew in double precision, or subtract an offset from the coordinates before the export",
        )
    return tuple(f"the coordinates are rounded, {each}" for each in rounded if each.step_m > _HARMFUL_M)


def rounded_axes(points: FloatArray, metres: float = 1.0, sides: FloatArray | None = None) -> list[Rounded]:
    """How the axes of `points` (n, 3), in a unit of so many metres, were rounded to more than 1 mm; none where it is a grid.

    sides: (m, 3, 3) absolute differences along the sides of the triangles between them, where there are some.
    """
    if not len(points):
        return []
    steps = [step_of(column) for column in points.T]
    largest = [float(np.abs(column).max()) for column in points.T]
    single = _are_float32(points)
    float32 = [bool(single and step <= np.spacing(np.float32(most))) for step, most in zip(steps, largest, strict=True)]
    kept = [
        Rounded(name, step * metres, bool(np.isin(step, _POWERS_OF_2)), float32[axis], largest[axis] * metres)
        for axis, (name, step) in enumerate(zip("xyz", steps, strict=True))
        if step * metres > _HARMLESS_M
        and (all(float32) or len(np.unique(np.rint(points[:, axis] / step))) >= _FEWEST_LEVELS)
        and (sides is None or not _is_regular(sides[:, :, axis], step))
    ]
    return _without_rasters(kept)


def _without_rasters(rounded: list[Rounded]) -> list[Rounded]:
    """None where two axes alone have the same step, which is the grid that the vertices were taken from."""
    taken = len(rounded) == 2 and rounded[0].step_m == rounded[1].step_m and not all(each.float32 for each in rounded)
    return [] if taken else rounded


def _are_float32(points: FloatArray) -> bool:
    """Whether all coordinates are numbers of single precision."""
    with np.errstate(over="ignore"):
        return bool(np.array_equal(points.astype(np.float32).astype(np.float64), points))


def _is_regular(sides: FloatArray, step: float) -> bool:
    """Whether the axis is that of a regular grid: nearly all triangles span one cell of it. sides: (m, 3)."""
    ordered = np.sort(sides, axis=1)
    cell = np.median(ordered[:, 2])
    one = (ordered[:, 0] < _CLOSE * step) & (np.abs(ordered[:, 1:] - cell) < _CLOSE * step).all(axis=1)
    return bool(cell > 0 and np.mean(one) > _REGULAR)


def _are_multiples(apart: FloatArray, step: float) -> bool:
    ratio = apart / step
    return bool(np.all(np.abs(ratio - np.rint(ratio)) < _CLOSE))
