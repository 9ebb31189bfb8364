"""Blocks and events as GeoDataFrames in the wall frame, other tables as DataFrames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.api.extras import library
from pipeline.formats.rasters.geotiff import wall_frame_wkt

if TYPE_CHECKING:
    import geopandas
    import pandas


def frame(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> pandas.DataFrame:
    """A table of rows; columns: their order where there may be no rows."""
    return library("pandas").DataFrame(list(rows), columns=columns)


def boxes(
    rows: Iterable[Mapping[str, Any]], bounds: Iterable[Sequence[float]], columns: Sequence[str] | None = None
) -> geopandas.GeoDataFrame:
    """A table whose rows lie at rectangles on the wall. bounds: x_min, y_min, x_max, y_max of each, wall frame, m."""
    shapely, geopandas = library("shapely"), library("geopandas")
    geometry = [shapely.box(*bound) for bound in bounds]
    return geopandas.GeoDataFrame(frame(rows, columns), geometry=geometry, crs=wall_frame_wkt())


def spread_out(name: str, values: Sequence[float], axes: str = "xyz", unit: str = "_m") -> dict[str, float]:
    """A vector as one column for each axis: position_x_m, position_y_m, ..."""
    return {f"{name}_{axis}{unit}": value for axis, value in zip(axes, values, strict=True)}


def frame_of(columns: Mapping[str, Any], index: Sequence[str], name: str) -> pandas.DataFrame:
    """A table of columns with a named index."""
    pandas = library("pandas")
    return pandas.DataFrame(dict(columns), index=pandas.Index(index, name=name))
