"""What can be looked at: rasters, points and things in boxes, all in the wall frame, cut to a window and thinned to a budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_SURROUNDINGS, _LEAST_M, _ASPECT = 4.0, 1.0, 2.5
"""An item is shown with this many times its size, and the smallest as if it were so large; width over height of the view."""


class ViewWindow(NamedTuple):
    """A part of the wall, m, wall frame."""

    x0: float
    x1: float
    y0: float
    y1: float


@dataclass(frozen=True)
class Layer:
    """A quantity by which the wall is coloured. limit: colours end here, in the layer's unit; None: at the 1 and 99 % quantiles.

    diverging: about zero, from -limit to limit; factor: from the file's metres to `unit`.
    """

    key: str
    label: str
    unit: str
    factor: float = 1.0
    diverging: bool = False
    limit: float | None = None


INSTRUMENTS = {"stereo": "stereo pair", "tls": "laser scanner"}


@dataclass(frozen=True)
class Patch:
    """A raster over a window. x: (w,), y: (h,) centres, m; height: (h, w) m; value: (h, w) in the layer's unit, both NaN without
    data; label: (h, w) number of the block, 0 for none; pooled: pixels of the file, each way, in one of these."""

    x: FloatArray
    y: FloatArray
    height: NDArray[np.floating]
    value: NDArray[np.floating]
    label: NDArray[np.integer]
    pooled: int


@dataclass(frozen=True)
class PointLayer:
    """Points in a window. points: (n, 3) m; value: (n,) of the layer, or None; facts: (n,) by name; share: of all there are."""

    points: FloatArray
    value: FloatArray | None
    facts: Mapping[str, NDArray[Any]]
    share: float


@dataclass(frozen=True)
class Item:
    """A thing to click on.

    kind: block, detection, event, scene change; box: x0, x1, y0, y1, z0, z1, m, z NaN where it is not known.
    """

    kind: str
    name: str
    box: tuple[float, float, float, float, float, float]
    facts: Mapping[str, str] = field(default_factory=dict)

    def window(self) -> ViewWindow:
        """The item with its surroundings, of the page's wide shape."""
        x0, x1, y0, y1 = self.box[:4]
        half = max(x1 - x0, y1 - y0, _LEAST_M) * _SURROUNDINGS / 2
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        return ViewWindow(x - _ASPECT * half, x + _ASPECT * half, y - half, y + half)


class Results(Protocol):
    """A folder that can be looked at. steps, surfaces: keys and what people read; the first is shown first."""

    title: str
    step_name: str

    @property
    def steps(self) -> Mapping[str, str]: ...
    @property
    def surfaces(self) -> Mapping[str, str]: ...

    def layers(self, step: str) -> Sequence[Layer]:
        """What the wall can be coloured by."""
        ...

    def patch(self, step: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """The surface in a window (None: all of it), coloured by the layer, of at most about `budget` cells."""
        ...

    def points(self, step: str, layer: Layer, window: ViewWindow | None, budget: int) -> PointLayer | None:
        """The measured points in a window, at most about `budget` of them; None where the folder holds none."""
        ...

    def items(self, step: str) -> Sequence[Item]:
        """Blocks, detections and the like of a step."""
        ...


def cut(grid: Grid, window: ViewWindow | None, budget: int) -> tuple[slice, slice, int]:
    """Rows and columns of `grid` inside `window` (at least one), and how many pixels, each way, to take together for `budget`."""
    window = window or ViewWindow(-np.inf, np.inf, -np.inf, np.inf)
    columns = _inside(grid.columns(np.array([window.x0, window.x1])), grid.width)
    rows = _inside(grid.rows(np.array([window.y1, window.y0])), grid.height)
    cells = (rows.stop - rows.start) * (columns.stop - columns.start)
    factor = max(1, int(np.ceil(np.sqrt(cells / budget))))
    return rows, columns, min(factor, rows.stop - rows.start, columns.stop - columns.start)


def _inside(edges: FloatArray, size: int) -> slice:
    first = int(np.clip(np.floor(edges[0]), 0, size - 1))
    return slice(first, int(np.clip(np.ceil(edges[1]), first + 1, size)))


def centres(grid: Grid, rows: slice, columns: slice, factor: int) -> tuple[FloatArray, FloatArray]:
    """x (w,) and y (h,) of the centres of cells of `factor` pixels, m."""
    width, height = (columns.stop - columns.start) // factor, (rows.stop - rows.start) // factor
    x = grid.x_min + (columns.start + (np.arange(width) + 0.5) * factor) * grid.gsd
    y = grid.y_max - (rows.start + (np.arange(height) + 0.5) * factor) * grid.gsd
    return x, y


def inside(points: FloatArray, window: ViewWindow | None) -> NDArray[np.bool_]:
    """(n,) which of the points (n, 3) lie in the window."""
    if window is None:
        return np.ones(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    return (x >= window.x0) & (x <= window.x1) & (y >= window.y0) & (y <= window.y1)
