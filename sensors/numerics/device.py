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


def bounded(value: Any, low: Any, high: Any) -> Any:
    """`value` between `low` and `high`, a device array of any type (dr.clip's minimum aborts in LLVM 15)."""
    return dr.select(value < low, low, dr.select(value > high, high, value))
