"""Read the position and the units of a TIFF's pixels, from the tags of GeoTIFF 1.1 and of GDAL.

The tie point of GeoTIFF is at the outer corner of a pixel, or at its centre if the file says that a pixel is a point.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.formats.files.xml_file import parsed
from pipeline.formats.units import metres_of_epsg_unit, understood_crs, units_of_crs
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray

PIXEL_SCALE, TIEPOINT, TRANSFORMATION, GEO_KEYS, GDAL_METADATA = 33550, 33922, 34264, 34735, 42112
MODEL_TYPE, RASTER_TYPE, LINEAR_UNITS, VERTICAL_UNITS = 1024, 1025, 3076, 4099
_PROJECTED, _USER_DEFINED = 3072, 32767
_GEOGRAPHIC, _PIXEL_IS_POINT = 2, 2
_SIDES_M, _FARTHEST_M = (1e-6, 1e6), 1e8
"""Allowed sides of a pixel, and largest coordinate of a survey, m."""
_SQUARE = 1e-9
"""Relative difference of the sides up to which a pixel is square."""
_TIES_AGREE = 0.01
"""Largest difference of tie points, as a share of a pixel."""


@dataclass(frozen=True)
class Georeference:
    """Where a GeoTIFF's pixels are, and in which units, as far as the file states it.

    Attributes
    ----------
    grid : Position and size of the pixels, m; None if the file does not state them.
    flipped : Whether the first row of the file is the southernmost.
    linear_m, vertical_m : Length of the stated units of coordinates and heights, m; None if the file states none.
    epsg : EPSG code of the projected coordinate system; None if the file states none.
    """

    grid: Grid | None
    flipped: bool
    linear_m: float | None
    vertical_m: float | None
    epsg: int | None = None


def georeference(tags: dict[int, Any], shape: tuple[int, int], path: Path) -> Georeference:
    """Read from the tags of a GeoTIFF where its pixels are.

    Parameters
    ----------
    tags : dict
        Values of the first page's tags by their code.
    shape : (int, int)
        Rows and columns of the raster.
    path : Path
        The file, for errors.

    Returns
    -------
    Georeference

    Raises
    ------
    InputError
        For geographic coordinates, unknown units, pixels that are not square or not along the axes, or an impossible place.
    """
    keys = _geo_keys(tags, path)
    linear, vertical = (_unit(keys, key, path) for key in (LINEAR_UNITS, VERTICAL_UNITS))
    linear = _unit_of_code(keys, path) if linear is None else linear
    code = keys.get(_PROJECTED, _USER_DEFINED)
    epsg = code if 0 < code < _USER_DEFINED else None
    corner = _affine(tags, path)
    if corner is None:
        return Georeference(None, False, linear, vertical, epsg)
    if keys.get(MODEL_TYPE) == _GEOGRAPHIC:
        raise InputError(
            "the raster is in geographic coordinates, degrees",
            where=str(path),
            allowed="metres or feet",
            remedy="reproject the raster to the projected coordinates of the points, in metres",
        )
    gsd, step_y, x, y = (value * (linear or 1.0) for value in corner)
    if not (_SIDES_M[0] <= gsd <= _SIDES_M[1] and max(abs(x), abs(y)) <= _FARTHEST_M):
        place = f"a pixel of {gsd:g} m with its first corner at {x:g}, {y:g}"
        raise InputError(
            f"the raster has {place}",
            where=str(path),
            allowed=f"sides of {_SIDES_M[0]:g} to {_SIDES_M[1]:g} m, coordinates of up to {_FARTHEST_M:g} m",
            remedy="export the raster again with pixels and coordinates in metres",
        )
    if keys.get(RASTER_TYPE) == _PIXEL_IS_POINT:
        x, y = x - gsd / 2, y - step_y / 2
    flipped = step_y > 0
    y_max = y + shape[0] * step_y if flipped else y
    return Georeference(Grid(x, y_max, gsd, shape[1], shape[0]), flipped, linear, vertical, epsg)


def _affine(tags: dict[int, Any], path: Path) -> tuple[float, float, float, float] | None:
    """Return step of x, step of y, and x and y of the first pixel, in the file's unit; None if the file states no place.

    A negative step of y means that the first row is the northernmost.
    """
    scale, tie, matrix = tags.get(PIXEL_SCALE), tags.get(TIEPOINT), tags.get(TRANSFORMATION)
    if scale is not None and tie is not None and len(tie) >= 6:
        step_x, step_y = float(scale[0]), -float(scale[1])
        x, y = _corner(np.asarray(tie, dtype=np.float64), step_x, step_y, path)
        turned = False
    elif matrix is not None and len(matrix) == 16:
        step_x, step_y, x, y = (float(matrix[place]) for place in (0, 5, 3, 7))
        turned = max(abs(float(matrix[1])), abs(float(matrix[4]))) > _SQUARE * abs(step_x)
    elif tie is not None:
        problem = f"the file states {len(tie) // 6} tie points but no size of its pixels"
        raise InputError(problem, where=str(path), remedy="resample it to square pixels along the axes (gdalwarp)")
    else:
        return None
    if turned or not step_x > 0 or not np.isclose(step_x, abs(step_y), rtol=_SQUARE, atol=0):
        problem = (
            "the pixels are rotated relative to the axes" if turned else f"the pixels are {step_x:g} x {abs(step_y):g} units"
        )
        raise InputError(
            problem,
            where=str(path),
            allowed="square pixels, columns towards larger x",
            remedy="resample it to square pixels along the axes (gdalwarp)",
        )
    return step_x, step_y, x, y


def _corner(ties: FloatArray, step_x: float, step_y: float, path: Path) -> tuple[float, float]:
    """Return x and y of the first pixel, in the file's unit, from tie points of (column, row, 0, x, y, height) each.

    Raises InputError if tie points disagree by more than a hundredth of a pixel, that is, if the raster is warped.
    """
    column, row, _, x, y, _ = ties[: len(ties) // 6 * 6].reshape(-1, 6).T
    corners = np.column_stack([x - column * step_x, y - row * step_y])
    farthest = float(np.abs(corners - corners[0]).max())
    if not farthest <= _TIES_AGREE * abs(step_x):
        raise InputError(
            f"the raster's {len(corners)} tie points disagree by up to {farthest:.4g} units with pixels of {step_x:g} units",
            where=str(path),
            remedy="resample it to square pixels along the axes (gdalwarp)",
        )
    return float(corners[0, 0]), float(corners[0, 1])


def _geo_keys(tags: dict[int, Any], path: Path) -> dict[int, int]:
    """Return the GeoTIFF keys whose value is a 16-bit number."""
    values = tags.get(GEO_KEYS)
    if values is None:
        return {}
    rows = list(zip(*(tuple(values)[4 + part :: 4] for part in range(4)), strict=False))
    if len(values) < 4 or len(rows) < values[3]:
        raise InputError(
            f"the file states {values[3] if len(values) > 3 else 0} GeoTIFF keys but has {len(rows)} keys",
            where=str(path),
            remedy="export the GeoTIFF again, for example with gdal_translate",
        )
    return {int(key): int(value) for key, location, _, value in rows if location == 0}


def _unit(keys: dict[int, int], key: int, path: Path) -> float | None:
    """Return the length of the unit that a key states, m; None without the key, or for a user-defined unit."""
    code = keys.get(key)
    if code is None or code == _USER_DEFINED:
        return None
    metres = metres_of_epsg_unit(code)
    if metres is None:
        raise InputError(
            f"the file states the unit EPSG {code}, which is not a length",
            where=str(path),
            allowed="a unit of length",
            remedy="reproject the raster to coordinates in metres",
        )
    return metres


def _unit_of_code(keys: dict[int, int], path: Path) -> float | None:
    """Return the length, m, of the unit of the projected coordinate system that the file names.

    The file names it by its EPSG code; None without one.
    """
    code = keys.get(_PROJECTED)
    crs = None if code in (None, _USER_DEFINED) else understood_crs(f"EPSG:{code}")
    units = None if crs is None else units_of_crs(crs, str(path))
    return None if units is None else units.metres[0]


def scale_and_offset(tags: dict[int, Any], path: Path) -> tuple[float, float]:
    """Return scale and offset by which the stored values of a GeoTIFF become heights: height = scale * value + offset.

    tags: values of the first page's tags by their code, of which GDAL's metadata are read. path: the file, for errors.
    """
    found = {"scale": 1.0, "offset": 0.0}
    text = tags.get(GDAL_METADATA)
    if not text or "role=" not in str(text):
        return found["scale"], found["offset"]
    items = parsed(str(text).strip("\0 ").encode(), f"{path}: GDAL_METADATA")
    try:
        found |= {str(item.get("role")): float(item.text or "") for item in items if item.get("role") in found}
    except ValueError:
        raise InputError(
            "the scale or the offset of the raster's values is not a number",
            where=f"{path}: GDAL_METADATA",
            remedy="export the GeoTIFF again, for example with gdal_translate",
        ) from None
    return found["scale"], found["offset"]
