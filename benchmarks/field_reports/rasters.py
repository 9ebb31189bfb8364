"""Public reports about elevation models: GeoTIFF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

from benchmarks.field_reports.report import Report, refused
from pipeline.formats.rasters.geotiff import read_raster

_SHAPE = (40, 50)
_SCALE, _TIE, _MATRIX = 33550, 33922, 34264
_KEYS = (34735, 3, 16, (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32632), False)
"""Projected, pixels are areas, UTM zone 32."""


def _heights() -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    row, column = np.mgrid[: _SHAPE[0], : _SHAPE[1]]
    return np.asarray(400.0 + np.sin(row / 5.0) + 0.01 * column, dtype=np.float32)


def _written(folder: Path, *tags: tuple[int, int, int, tuple[float, ...], bool]) -> Path:
    tifffile.imwrite(folder / "dem.tif", _heights(), extratags=[*tags, _KEYS])
    return folder / "dem.tif"


def _ties(*places: tuple[float, ...]) -> tuple[int, int, int, tuple[float, ...], bool]:
    values = tuple(value for place in places for value in place)
    return (_TIE, 12, len(values), values, False)


def _ties_that_disagree(folder: Path) -> str:
    corners = [(0, 0, 0, 345_200, 5_389_480, 0), (50, 0, 0, 345_225, 5_389_480, 0), (50, 40, 0, 345_229, 5_389_457, 0)]
    path = _written(folder, (_SCALE, 12, 3, (0.5, 0.5, 0.0), False), _ties(*corners))
    return refused(lambda: read_raster(path), folder, "3 tie points disagree")


def _tie_without_scale(folder: Path) -> str:
    path = _written(folder, _ties((0, 0, 0, 345_200, 5_389_480, 0)))
    return refused(lambda: read_raster(path), folder, "no size of its pixels")


def _matrix(turned: float) -> tuple[int, int, int, tuple[float, ...], bool]:
    values = (0.5, turned, 0, 345_200.0, turned, -0.5, 0, 5_389_480.0, 0, 0, 0, 0, 0, 0, 0, 1)
    return (_MATRIX, 12, 16, tuple(map(float, values)), False)


def _matrix_alone(folder: Path) -> str:
    raster = read_raster(_written(folder, _matrix(0.0)))
    grid = raster.place.grid
    assert grid is not None
    assert (grid.gsd, grid.x_min, grid.y_max) == (0.5, 345_200.0, 5_389_480.0), grid
    assert np.array_equal(raster.values, _heights())
    return f"reads {_SHAPE[1]} x {_SHAPE[0]} pixels of 0.5 m in their place"


def _turned(folder: Path) -> str:
    path = _written(folder, _matrix(0.001))
    return refused(lambda: read_raster(path), folder, "dem.tif", "rotated")


REPORTS = (
    Report("xarray-contrib/xarray-spatial#2117", "tie points of a raster that disagree", "refuse it", _ties_that_disagree),
    Report("xarray-contrib/xarray-spatial#1760", "a tie point and no pixel size", "refuse it", _tie_without_scale),
    Report("geotiffjs/geotiff.js#40", "a place given by a matrix alone", "read its place", _matrix_alone),
    Report("deegree/deegree3#826", "a raster turned by a thousandth", "refuse it", _turned),
)
