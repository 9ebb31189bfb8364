"""Small vector algebra on the device, with numbers as arguments of the compiled kernel instead of constants in it."""

from __future__ import annotations

from typing import Any

from scene.common.backend import dr, mi
from scene.geometry.mesh import FloatArray


def opaque(*values: float) -> list[mi.Float64]:
    """Device scalars that one compiled kernel serves whatever their values."""
    return [dr.opaque(mi.Float64, float(value)) for value in values]


def vector(values: FloatArray) -> mi.Array3f64:
    """A (3,) NumPy vector as a device vector."""
    return mi.Array3f64(*opaque(*values))


def rotated(matrix: FloatArray, vectors: mi.Array3f64) -> mi.Array3f64:
    """`matrix` ((3, 3) NumPy) times the 3 x (n,) device vectors."""
    return mi.Array3f64(*(dr.dot(vector(row), vectors) for row in matrix))


def cell_index(place: Any, count: int) -> mi.UInt32:
    """Return the number of the cell in which each place lies, safe for `dr.gather` whatever the place is.

    A gather outside its array ends the process, so every index that is computed from a sensor's values comes from here.

    Parameters
    ----------
    place : mi.Float32 or mi.Float64, (n,)
        Place along the array in cells, cell k covering k <= place < k + 1. Any value, NaN and infinities too.
    count : int
        Number of cells, at least 1.

    Returns
    -------
    mi.UInt32, (n,)
        Numbers from 0 to count - 1. Places before the first cell and NaN give 0, places behind the last cell give count - 1.
        Values that are computed with the share `place - index` stay NaN where the place is NaN.
    """
    last = dr.opaque(type(place), count - 1)
    floor = dr.select(place > 0, dr.floor(place), 0)
    return mi.UInt32(dr.select(floor < last, floor, last))  # dr.clip's minimum aborts in LLVM 15


def bounded(value: Any, low: Any, high: Any) -> Any:
    """`value` between `low` and `high`, a device array of any type (dr.clip's minimum aborts in LLVM 15)."""
    return dr.select(value < low, low, dr.select(value > high, high, value))
