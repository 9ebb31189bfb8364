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
    """A rectangular part of the wall that the viewer shows: limits in x (along the wall) and y (up the wall), wall frame, m."""

    x0: float
    x1: float
    y0: float
    y1: float


@dataclass(frozen=True)
class Layer:
    """A quantity by which the viewer colours the wall, such as the difference of two epochs.

    Attributes
    ----------
    key, label, unit : str
        Identifier, title of the colour scale, and unit.
    factor : float
        Conversion of the values from the file's metres to `unit`.
    diverging : bool
        Whether the colour scale is symmetric about zero, from -limit to limit.
    limit : float, optional
        End of a symmetric colour scale, in `unit`. Other scales end at the 1 and 99 % quantiles of the values.
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
    """Heights and colours of the surface in the part of the wall that the viewer shows, as a raster.

    A cell of the raster is the mean of several pixels of the file if the part has too many to draw.

    Attributes
    ----------
    x, y : (w,) and (h,) arrays
        Centres of the cells, wall frame, m; y decreases from row to row.
    height, value : (h, w) arrays
        Height, m, and the quantity that gives the colours, in the unit of the layer; NaN without data.
    label : (h, w) array
        Number of the block or event in each cell, 0 for none.
    pooled : int
        Number of pixels along each side of a cell.
    """

    x: FloatArray
    y: FloatArray
    height: NDArray[np.floating]
    value: NDArray[np.floating]
    label: NDArray[np.integer]
    pooled: int


@dataclass(frozen=True)
class PointLayer:
    """Measured points in the part of the wall that the viewer shows.

    Attributes
    ----------
    points : (n, 3) array
        Positions, wall frame, m.
    value : (n,) array, optional
        Values that give the colours, in the layer's unit; None: the points are grey.
    facts : mapping of (n,) arrays
        Further properties by name, shown when the user points at a point.
    share : float
        Number of these points over that of all measured ones, as large clouds are drawn in part.
    """

    points: FloatArray
    value: FloatArray | None
    facts: Mapping[str, NDArray[Any]]
    share: float


@dataclass(frozen=True)
class Item:
    """Something on the wall that the user can select in the viewer: a block, a detection, an event or a change.

    Attributes
    ----------
    kind : str
        "block", "detection", "event" or "scene change".
    name : str
        Title, such as "block 3".
    box : tuple
        Limits x0, x1, y0, y1, z0, z1, wall frame, m; z is NaN if unknown.
    facts : mapping of str
        Properties by name, as text, such as the volume.
    """

    kind: str
    name: str
    box: tuple[float, float, float, float, float, float]
    facts: Mapping[str, str] = field(default_factory=dict)

    def window(self) -> ViewWindow:
        """Return the part of the wall to show when this item is selected: centred on it, four times as high as its longer side.

        An item smaller than 1 m counts as 1 m large.
        """
        x0, x1, y0, y1 = self.box[:4]
        half = max(x1 - x0, y1 - y0, _LEAST_M) * _SURROUNDINGS / 2
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        return ViewWindow(x - _ASPECT * half, x + _ASPECT * half, y - half, y + half)


class Results(Protocol):
    """Interface of the folders of results that the page of `scarpsim view` can show, with one class for each kind of folder.

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
        Label on the page by key; methods take the key. The first one is shown first.
    """

    title: str
    step_name: str

    @property
    def steps(self) -> Mapping[str, str]:
        """Labels of the states between which the user moves, such as epochs, by key; the first is shown first."""
        ...

    @property
    def surfaces(self) -> Mapping[str, str]:
        """Labels of the surfaces that can be drawn, such as the reference and the epoch, by key; the first is shown first."""
        ...

    def layers(self, step: str) -> Sequence[Layer]:
        """Return the quantities that can give the colours, such as the difference.

        step: key of the state that is shown, such as an epoch.
        """
        ...

    def patch(self, step: str, surface: str, layer: Layer, window: ViewWindow | None, budget: int) -> Patch:
        """Return the surface in a part of the wall, coloured by a quantity, to be drawn by the viewer.

        Parameters
        ----------
        step, surface : str
            Keys of the state (such as an epoch) and of the surface (such as that of the reference).
        layer : Layer
            The quantity that gives the colours.
        window : ViewWindow or None
            Part of the wall; None: all of it.
        budget : int
            Approximate upper limit on the number of cells; pixels are averaged to keep it.
        """
        ...

    def points(self, step: str, layer: Layer, window: ViewWindow | None, budget: int) -> PointLayer | None:
        """Return at most about `budget` of the measured points in a part of the wall; None if the folder has no points.

        Parameters
        ----------
        step : str
            Key of the state, such as an epoch.
        layer : Layer
            The quantity that gives the colours.
        window : ViewWindow or None
            Part of the wall; None: all of it.
        budget : int
            Approximate upper limit on the number of points.
        """
        ...

    def items(self, step: str) -> Sequence[Item]:
        """Return the blocks, detections, events or changes that the user can select.

        step: key of the state that is shown, such as an epoch.
        """
        ...


def cut(grid: Grid, window: ViewWindow | None, budget: int) -> tuple[slice, slice, int]:
    """Find the pixels of a raster in a part of the wall, and how many of them to average so that the viewer can draw them.

    Parameters
    ----------
    grid : Grid
        The raster.
    window : ViewWindow or None
        Part of the wall; None: all of it.
    budget : int
        Approximate upper limit on the number of cells to draw.

    Returns
    -------
    slice, slice and int
        Rows and columns, at least one of each, and the number of pixels along each side of a cell.
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
    """Return the centres of the cells into which a part of a raster is divided for drawing: x (w,) and y (h,), wall frame, m.

    Parameters
    ----------
    grid : Grid
        The raster.
    rows, columns : slice
        The part of it.
    factor : int
        Number of pixels along each side of a cell.
    """
    width, height = (columns.stop - columns.start) // factor, (rows.stop - rows.start) // factor
    x = grid.x_min + (columns.start + (np.arange(width) + 0.5) * factor) * grid.gsd
    y = grid.y_max - (rows.start + (np.arange(height) + 0.5) * factor) * grid.gsd
    return x, y


def inside(points: FloatArray, window: ViewWindow | None) -> NDArray[np.bool_]:
    """Return a mask (n,) of the points that lie in a part of the wall, as seen by the viewer; all do if it is None.

    points: (n, 3), wall frame, m. window: limits of the part in x and y.
    """
    if window is None:
        return np.ones(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    return (x >= window.x0) & (x <= window.x1) & (y >= window.y0) & (y <= window.y1)
