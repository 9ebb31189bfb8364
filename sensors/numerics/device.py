"""Provide vector algebra on the device. Numbers are arguments of the compiled kernel, so that one kernel serves all values."""

from __future__ import annotations

from typing import Any

from scene.common.backend import dr, mi
from scene.geometry.mesh import FloatArray


def opaque(*values: float) -> list[mi.Float64]:
    """Convert numbers to scalars of the ray-tracing device that a compiled kernel takes as arguments, not as constants.

    Other numbers then need no new compilation.
    """
    return [dr.opaque(mi.Float64, float(value)) for value in values]


def vector(values: FloatArray) -> mi.Array3f64:
    """Convert a NumPy vector (3,) to a vector of the ray-tracing device."""
    return mi.Array3f64(*opaque(*values))


def rotated(matrix: FloatArray, vectors: mi.Array3f64) -> mi.Array3f64:
    """Multiply a NumPy matrix (3, 3), such as a rotation, with n vectors on the ray-tracing device, 3 x (n,)."""
    return mi.Array3f64(*(dr.dot(vector(row), vectors) for row in matrix))


def cell_index(place: Any, count: int) -> mi.UInt32:
    """Return the number of the table's cell that contains each position, to read the table on the ray-tracing device.

    The result is a valid index for Dr.Jit's `dr.gather` whatever the position. A gather outside its array ends the process, so
    every index that is computed from sensor values should come from here.

    Parameters
    ----------
    place : mi.Float32 or mi.Float64, (n,)
        Position along the array in cells; cell k covers k <= place < k + 1. NaN and infinite values are allowed.
    count : int
        Number of cells, at least 1.

    Returns
    -------
    mi.UInt32, (n,)
        Numbers from 0 to count - 1. NaN and positions before the first cell give 0, positions after the last cell count - 1.
        Values computed with the share `place - index` remain NaN where the position is NaN.
    """
    last = dr.opaque(type(place), count - 1)
    floor = dr.select(place > 0, dr.floor(place), 0)
    return mi.UInt32(dr.select(floor < last, floor, last))  # dr.clip's minimum aborts in LLVM 15


def bounded(value: Any, low: Any, high: Any) -> Any:
    """Clip `value`, an array of the ray-tracing device of any type, to the interval from `low` to `high`.

    dr.clip would do, but its minimum aborts in LLVM 15.
    """
    return dr.select(value < low, low, dr.select(value > high, high, value))
