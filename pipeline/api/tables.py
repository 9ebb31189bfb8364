"""Make GeoDataFrames of things with a position on the wall, and DataFrames of everything else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.api.extras import library
from pipeline.formats.rasters.geotiff import wall_frame_wkt

if TYPE_CHECKING:
    import geopandas
    import pandas


def frame(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> pandas.DataFrame:
    """Return a DataFrame from its rows. rows: values by column's name. columns: their order, needed for a table without rows."""
    return library("pandas").DataFrame(list(rows), columns=columns)


def boxes(
    rows: Iterable[Mapping[str, Any]], bounds: Iterable[Sequence[float]], columns: Sequence[str] | None = None
) -> geopandas.GeoDataFrame:
    """Return a GeoDataFrame in the wall frame with a rectangle per row.

    Parameters
    ----------
    rows : iterable of mappings
        The rows of the table.
    bounds : iterable of (x_min, y_min, x_max, y_max)
        Rectangle of each row, wall frame, m.
    columns : sequence of str, optional
        Order of the columns, also when there are no rows.
    """
    shapely, geopandas = library("shapely"), library("geopandas")
    geometry = [shapely.box(*bound) for bound in bounds]
    return geopandas.GeoDataFrame(frame(rows, columns), geometry=geometry, crs=wall_frame_wkt())


def spread_out(name: str, values: Sequence[float], axes: str = "xyz", unit: str = "_m") -> dict[str, float]:
    """Return a vector as one table column per axis, such as position_x_m, position_y_m and position_z_m.

    name: first part of the columns' names. values: the components, in the order of `axes`. axes: a letter for each component.
    unit: end of the columns' names.
    """
    return {f"{name}_{axis}{unit}": value for axis, value in zip(axes, values, strict=True)}


def frame_of(columns: Mapping[str, Any], index: Sequence[str], name: str) -> pandas.DataFrame:
    """Return a DataFrame from its columns.

    columns: values by the column's name. index: label of each row. name: name of the index.
    """
    pandas = library("pandas")
    return pandas.DataFrame(dict(columns), index=pandas.Index(index, name=name))
