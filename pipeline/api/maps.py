"""Convert rasters of the wall to and from xarray.DataArray, with coordinates, units and the wall frame as coordinate system."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.api.extras import library
from pipeline.formats.rasters.geotiff import wall_frame_wkt
from scene.common.errors import InputError
from scene.geometry.frame import WallFrame
from scene.geometry.grid import Grid

if TYPE_CHECKING:
    import xarray

DIFFERENCE = "reference minus epoch; missing rock positive"
_SPREAD = 1e-6
"""Largest difference between the steps of a map's coordinates, as a share of a pixel, for which the pixels count as square."""


def data_array(
    values: NDArray[Any], grid: Grid, name: str, long_name: str, *, units: str = "m", frame: WallFrame | None = None
) -> xarray.DataArray:
    """Return rasters on one grid as a DataArray with coordinates.

    Parameters
    ----------
    values : (h, w) or (e, h, w) array
        One raster, or the rasters of epochs 1 to e.
    grid : Grid
        Position of the pixels in the wall frame.
    name, long_name : str
        Name of the array, and its description in the attributes.
    units : str
        Unit of the values.
    frame : WallFrame, optional
        If given, its matrix (4, 4) from world to wall is stored by rows in the attribute `matrix_world_to_wall`.

    Returns
    -------
    xarray.DataArray
        x and y are the pixels' centres, wall frame, m. `.rio.crs` is the wall frame as a local coordinate system, as in the
        GeoTIFFs.
    """
    xarray = library("xarray")
    library("rioxarray")  # gives DataArrays their `.rio`
    x = grid.x_min + (np.arange(grid.width) + 0.5) * grid.gsd
    y = grid.y_max - (np.arange(grid.height) + 0.5) * grid.gsd
    coordinates: dict[str, Any] = {
        "y": ("y", y, {"units": "m", "long_name": "up the wall"}),
        "x": ("x", x, {"units": "m", "long_name": "along the wall"}),
    }
    dimensions: tuple[str, ...] = ("y", "x")
    if values.ndim == 3:
        dimensions = ("epoch", *dimensions)
        coordinates["epoch"] = ("epoch", np.arange(1, len(values) + 1), {"long_name": "epoch, 0 is the reference"})
    attributes: dict[str, Any] = {"units": units, "long_name": long_name, "gsd_m": grid.gsd}
    if frame is not None:
        attributes["matrix_world_to_wall"] = frame.matrix.ravel().tolist()
    array = xarray.DataArray(values, coordinates, dimensions, name, attributes)
    return array.rio.write_crs(wall_frame_wkt()).rio.write_nodata(np.nan)


def dataset(rasters: Mapping[str, xarray.DataArray]) -> xarray.Dataset:
    """Combine rasters of one grid into a Dataset. rasters: (y, x) arrays by the name of their variable."""
    return library("xarray").Dataset(dict(rasters))


def raster_of(array: Any, where: str) -> tuple[NDArray[np.float32], Grid]:
    """Convert a user's difference map from a DataArray to an array and a grid, to be used by functions such as `detect`.

    array: a map with the dimensions y and x, whose coordinates are pixel centres in the wall frame, m. where: what errors
    should call it. Returns the values, (h, w) float32 with row 0 at the largest y, and the grid of the pixels. Raises
    InputError if it has other dimensions, fewer than 2 x 2 pixels, or pixels that are not square.
    """
    if set(array.dims) != {"y", "x"}:
        raise InputError(
            f"the map has the dimensions {', '.join(map(str, array.dims))}",
            where=where,
            allowed="y, x",
            remedy="give a two-dimensional map with the dimensions y and x",
        )
    array = array.sortby("y", ascending=False).sortby("x").transpose("y", "x")
    x, y = (np.asarray(array[name], dtype=np.float64) for name in ("x", "y"))
    if min(len(x), len(y)) < 2:
        raise InputError(
            f"the map has {len(y)} x {len(x)} pixels", where=where, allowed="at least 2 x 2", remedy="give a larger map"
        )
    steps = np.concatenate([np.diff(x), -np.diff(y)])
    gsd = float(np.median(steps))
    if not (gsd > 0 and np.ptp(steps) <= _SPREAD * gsd):
        raise InputError(
            f"the map has pixels with sides of {steps.min():g} to {steps.max():g} m",
            where=where,
            allowed="square pixels of one size",
            remedy="resample the map with xarray's array.interp to equal steps in x and y",
        )
    grid = Grid(float(x[0] - gsd / 2), float(y[0] + gsd / 2), gsd, len(x), len(y))
    return np.asarray(array.values, dtype=np.float32), grid
