"""Define what can be shown: rasters, points and items in boxes, in the wall frame, cut to a window and limited in number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

_SURROUNDINGS, _LEAST_M, _ASPECT = 4.0, 1.0, 2.5
"""Size of the view around an item, in sizes of the item; smallest size assumed, m; ratio of the view's width to height."""


class ViewWindow(NamedTuple):
    """A part of the wall, m, wall frame."""

    x0: float
    x1: float
    y0: float
    y1: float


@dataclass(frozen=True)
class Layer:
    """A quantity that gives the colours of the picture.

    Attributes
    ----------
    key, label, unit : str
        Identifier, title and unit.
    factor : float
        Conversion from the file's metres to `unit`.
    diverging : bool
        Whether the scale is symmetric about zero, from -limit to limit.
    limit : float, optional
        End of the colour scale, in `unit`; None: the 1 and 99 % quantiles.
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
    """Heights and colour values of the surface in a part of the wall.

    Attributes
    ----------
    x, y : (w,) and (h,) arrays
        Centres of the cells, m.
    height, value : (h, w) arrays
        Height, m, and value in the layer's unit; NaN without data.
    label : (h, w) array
        Block label, 0 for none.
    pooled : int
        Pixels of the file per cell, along a row or a column.
    """

    x: FloatArray
    y: FloatArray
    height: NDArray[np.floating]
    value: NDArray[np.floating]
    label: NDArray[np.integer]
    pooled: int


@dataclass(frozen=True)
class PointLayer:
    """Measured points in a part of the wall.

    Attributes
    ----------
    points : (n, 3) array
        Positions, m.
    value : (n,) array, optional
        Values of the layer.
    facts : mapping of (n,) arrays
        Further properties by name.
    share : float
        Share of all points that are shown.
    """

    points: FloatArray
    value: FloatArray | None
    facts: Mapping[str, NDArray[Any]]
    share: float


@dataclass(frozen=True)
class Item:
    """Something on the wall that can be selected: a block, a detection, an event or a change.

    Attributes
    ----------
    kind : str
        "block", "detection", "event" or "scene change".
    name : str
        Title.
    box : tuple
        x0, x1, y0, y1, z0, z1, wall frame, m; z is NaN if unknown.
    facts : mapping of str
        Properties by name.
    """

    kind: str
    name: str
    box: tuple[float, float, float, float, float, float]
    facts: Mapping[str, str] = field(default_factory=dict)

    def window(self) -> ViewWindow:
        """Return the window that shows the item with its surroundings, with the page's aspect ratio."""
        x0, x1, y0, y1 = self.box[:4]
        half = max(x1 - x0, y1 - y0, _LEAST_M) * _SURROUNDINGS / 2
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        return ViewWindow(x - _ASPECT * half, x + _ASPECT * half, y - half, y + half)


class Results(Protocol):
    """Base class of the result folders that the page of `scarpsim view` can show, one class for each kind of folder.

    A step is one of the states between which the user moves, such as an epoch. A surface is a raster of heights that the page
    can draw, such as that of the first or of the second epoch. An item is something on the wall that the user can select from a
    list, such as a block.

    Attributes
    ----------
    title : str
        Title of the page.
    step_name : str
        What a step is called, such as "epoch".
    steps, surfaces : mapping of str to str
        Label on the page by key, where the key is the argument of the methods; the first is shown first.
    """

    title: str
    step_name: str

    @property
    def steps(self) -> Mapping[str, str]:
        """Labels of the steps by key; the first is shown first."""
        ...

    @property
    def surfaces(self) -> Mapping[str, str]:
        """Labels of the surfaces by key; the first is shown first."""
        ...

    def layers(self, step: str) -> Sequence[Layer]:
        """Return the quantities that can give the colours of a step, given by its key."""
        ...

    def patch(self, step: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """Return the surface in a window (None: all of it), coloured by the layer, with at most about `budget` cells.

        Parameters
        ----------
        step, surface : str
            Keys of the step and the surface.
        layer : Layer
            Gives the colours.
        window : ViewWindow or None
            Part of the wall.
        budget : int
            Approximate limit on the number of cells.
        """
        ...

    def points(self, step: str, layer: Layer, window: ViewWindow | None, budget: int) -> PointLayer | None:
        """Return at most about `budget` of the measured points in a window; None if the folder has none.

        Arguments as in `patch`.
        """
        ...

    def items(self, step: str) -> Sequence[Item]:
        """Return the blocks, detections, events or changes of a step, given by its key, that the user can select."""
        ...


def cut(grid: Grid, window: ViewWindow | None, budget: int) -> tuple[slice, slice, int]:
    """Return the rows and columns of `grid` inside `window`, and how many pixels to average.

    There is at least one row and one column. The number of pixels is that along a row or a column for `budget` cells.
    """
    window = window or ViewWindow(-np.inf, np.inf, -np.inf, np.inf)
    columns = _inside(grid.columns(np.array([window.x0, window.x1])), grid.width)
    rows = _inside(grid.rows(np.array([window.y1, window.y0])), grid.height)
    cells = (rows.stop - rows.start) * (columns.stop - columns.start)
    factor = max(1, int(np.ceil(np.sqrt(cells / budget))))
    return rows, columns, min(factor, rows.stop - rows.start, columns.stop - columns.start)


def _inside(edges: FloatArray, size: int) -> slice:
    """Return the pixels between two edges."""
    first = int(np.clip(np.floor(edges[0]), 0, size - 1))
    return slice(first, int(np.clip(np.ceil(edges[1]), first + 1, size)))


def centres(grid: Grid, rows: slice, columns: slice, factor: int) -> tuple[FloatArray, FloatArray]:
    """Return x (w,) and y (h,) of the centres of cells of `factor` pixels, m."""
    width, height = (columns.stop - columns.start) // factor, (rows.stop - rows.start) // factor
    x = grid.x_min + (columns.start + (np.arange(width) + 0.5) * factor) * grid.gsd
    y = grid.y_max - (rows.start + (np.arange(height) + 0.5) * factor) * grid.gsd
    return x, y


def inside(points: FloatArray, window: ViewWindow | None) -> NDArray[np.bool_]:
    """Return which of the points (n, 3), wall frame, m, lie in the window, as a mask (n,); None: all."""
    if window is None:
        return np.ones(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    return (x >= window.x0) & (x <= window.x1) & (y >= window.y0) & (y <= window.y1)
