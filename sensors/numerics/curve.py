"""Interpolate tables linearly: curves and surfaces given by equally spaced values, the form of empirical effects."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from scene.common.backend import dr, mi
from scene.common.config import Config
from scene.geometry.mesh import FloatArray
from scene.ray_casting.upload import on_device
from sensors.numerics.device import bounded, cell_index, opaque

Rows = tuple[tuple[float, ...], ...]
_MOST_VALUES = 4096
"""Most values in one table."""


def _rectangular(rows: Rows) -> Rows:
    """Check that all rows have the same length, with at least two values and not too many in all."""
    if not rows or len({len(row) for row in rows}) != 1 or len(rows[0]) < 2 or len(rows) * len(rows[0]) > _MOST_VALUES:
        raise ValueError(f"needs rows of one length, 2 values each at least, {_MOST_VALUES} in all at most")
    return rows


Table = Annotated[Rows, AfterValidator(_rectangular)]
"""Values of a curve (one row) or a surface (several rows of equal length)."""


class Axis(Config):
    """Range of the variable that an empirical effect depends on; beyond it the outermost values hold.

    An empirical effect is a table of errors over a variable x, such as the range, without a known cause; its values are equally
    spaced from `low` to `high`.
    """

    low: float = Field(0.0, description="x of the first value, in its unit; held below")
    high: float = Field(1.0, description="x of the last value, in its unit; held above")
    period: float = Field(0.0, ge=0, description="period after which x repeats; 0: x does not repeat")

    @model_validator(mode="after")
    def _forward(self) -> Axis:
        if not self.high > self.low:
            raise ValueError("needs low < high")
        return self

    def place(self, x: Any, count: int) -> tuple[Any, Any]:
        """Locate values of x, a device array (n,), among `count` equally spaced values of a table, to interpolate between them.

        Returns the index of the table's value before each x, and the position between it and the next as a share in [0, 1].
        """
        if count < 2:
            return mi.UInt32(0), mi.Float64(0.0)
        if self.period:
            (cycle,) = opaque(self.period)
            x = x - cycle * dr.floor(x / cycle)
        start, step = opaque(self.low, (self.high - self.low) / (count - 1))
        place = bounded((x - start) / step, 0.0, count - 1.0)
        index = cell_index(place, count - 1)
        return index, place - mi.Float64(index)

    def place_on_host(self, x: FloatArray, count: int) -> tuple[Any, FloatArray]:
        """Locate values of x, a NumPy array (n,), among `count` equally spaced values of a table, to interpolate between them.

        Returns the index of the table's value before each x, and the position between it and the next as a share in [0, 1].
        """
        if count < 2:
            return np.zeros(len(x), dtype=np.int64), np.zeros(len(x))
        turned = np.mod(x, self.period) if self.period else x
        place = np.clip((turned - self.low) / (self.high - self.low) * (count - 1), 0, count - 1)
        index = np.minimum(np.nan_to_num(place).astype(np.int64), count - 2)
        return index, place - index


def interpolate(x: Any, y: Any, along: Axis, across: Axis, rows_of_values: Rows) -> mi.Float64:
    """Evaluate a table of an empirical error at x, y on the ray-tracing device, bilinearly; a single row is a curve of x.

    Parameters
    ----------
    x, y : device arrays, (n,)
        Where to evaluate. y plays no role for a single row.
    along, across : Axis
        Ranges of x and of y that the table covers.
    rows_of_values : rows of numbers
        The table: equally spaced rows along y, each with equally spaced values along x.

    Returns
    -------
    mi.Float64, (n,)
        Interpolated values.
    """
    values = np.asarray(rows_of_values, dtype=np.float64)
    rows, columns = values.shape
    (i, a), (j, b) = across.place(y, rows), along.place(x, columns)
    table = on_device(mi.Float64, values.ravel())
    first = i * columns + j
    low = _between(table, first, b)
    return low if rows == 1 else low + a * (_between(table, first + columns, b) - low)


def _between(table: mi.Float64, index: mi.UInt32, share: mi.Float64) -> mi.Float64:
    """Interpolate linearly between the table's entries at `index` and after it."""
    left, right = (dr.gather(mi.Float64, table, index + offset) for offset in (0, 1))
    return left + share * (right - left)


def interpolate_on_host(x: FloatArray, y: FloatArray, along: Axis, across: Axis, rows_of_values: Rows) -> FloatArray:
    """Evaluate a table of an empirical error at x, y with NumPy, bilinearly; a single row is a curve of x.

    Parameters
    ----------
    x, y : (n,) arrays
        Where to evaluate. y plays no role for a single row.
    along, across : Axis
        Ranges of x and of y that the table covers.
    rows_of_values : rows of numbers
        The table: equally spaced rows along y, each with equally spaced values along x.

    Returns
    -------
    (n,) array
        Interpolated values; NaN where x or y is NaN.
    """
    values = np.asarray(rows_of_values, dtype=np.float64)
    rows, columns = values.shape
    (i, a), (j, b) = across.place_on_host(y, rows), along.place_on_host(x, columns)
    below = np.minimum(i + 1, rows - 1)
    low, high = (values[row, j] * (1 - b) + values[row, j + 1] * b for row in (i, below))
    return np.asarray(low * (1 - a) + high * a)
