"""Read and write rasters: float32 TIFF, and GeoTIFF georeferenced to the wall frame.

Files are written uncompressed: on a noisy difference map, deflate saves a fifth but takes forty times as long.
"""

from __future__ import annotations

import logging
import lzma
import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from pipeline.formats.files.atomic import writing
from pipeline.formats.rasters.georeference import (
    GEO_KEYS,
    LINEAR_UNITS,
    MODEL_TYPE,
    PIXEL_SCALE,
    RASTER_TYPE,
    TIEPOINT,
    Georeference,
    georeference,
    scale_and_offset,
)
from scene.common.errors import InputError
from scene.common.regular_file import READ_LIMIT, check_file, read_limit_gb
from scene.geometry.grid import Grid

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # its warnings are also raised as exceptions
_GEO_ASCII, _NODATA = 34737, 42113
_ASCII, _SHORT, _DOUBLE = 2, 3, 12
_MASK_PAGE = 4
"""TIFF's NewSubfileType of a transparency mask."""
MOST_PIXELS = 250_000_000
"""Largest number of pixels of an image to read, 1 GB as float32; a small compressed file can claim any size."""
_LARGEST = 1e9
"""Largest value of a pixel."""
_USUAL_NODATA = tuple(np.float32(value) for value in (-9999, -99999, -32768, -32767, -3.4028235e38, 3.4028235e38, -1e30, 1e20))
"""Values that programs write for missing data (ESRI, SRTM, largest float32)."""
_DAMAGE = (
    ValueError,
    IndexError,
    KeyError,
    TypeError,
    AttributeError,
    ZeroDivisionError,
    OverflowError,
    RuntimeError,
    MemoryError,
)
"""Exceptions of tifffile for invalid or inconsistent tags, or libraries that are not installed."""
_DECOMPRESSORS: dict[int, Callable[[], Any]] = {8: zlib.decompressobj, 32946: zlib.decompressobj, 34925: lzma.LZMADecompressor}
"""Kinds of compression by which few bytes can become gigabytes."""
_SLACK = 65_536
"""Bytes by which a compressed part of an image may exceed an uncompressed one."""
_CITATION = "wall frame: x along the wall, y up the wall, z towards the sensors, metres"
_CITATION_KEY = 1026
_USER_DEFINED, _PIXEL_IS_AREA, _METRE = 32767, 1, 9001


def write_geotiff(
    path: Path, raster: NDArray[np.floating], grid: Grid, *, description: str = "", with_mask: bool = False
) -> None:
    """Write a raster over the wall, such as a difference map, as float32 GeoTIFF.

    Its coordinate system is the wall frame, a local one in metres (GeoTIFF 1.1, user-defined model, pixel is area).

    Parameters
    ----------
    path : File to write.
    raster : (h, w) values, m; NaN without data.
    grid : Place and scale of the pixels, wall frame.
    description : ASCII text.
    with_mask : Whether to add a second page with a transparency mask, one bit for each pixel with data, as GDAL reads it.
    """
    if raster.shape != grid.shape:
        raise ValueError(f"expected a raster of shape {grid.shape}, got {raster.shape}")
    _write(path, raster, description, _georeference(grid), with_mask=with_mask)


def wall_frame_wkt() -> str:
    """Return the wall frame as a coordinate system in WKT, local and in metres, as GDAL reads it from the GeoTIFFs."""
    axes = 'AXIS["Easting",EAST],AXIS["Northing",NORTH]'
    return f'LOCAL_CS["{_CITATION}",UNIT["metre",1,AUTHORITY["EPSG","{_METRE}"]],{axes}]'


def write_tiff(path: Path, image: NDArray[np.floating], *, description: str = "") -> None:
    """Write an image (h, w), such as a depth map, m, as float32 TIFF, without a place in the world. description: ASCII text."""
    _write(path, image, description, [(_NODATA, _ASCII, 0, "nan", False)])


@dataclass(frozen=True)
class Raster:
    """A raster of one band, such as an elevation model, as a file contains it.

    Attributes
    ----------
    values : (h, w) float32, north up, NaN without data, in the file's unit of heights.
    place : Position and units of its pixels.
    notes : What the user should know about how it was read.
    """

    values: NDArray[np.float32]
    place: Georeference
    notes: tuple[str, ...]


def read_raster(path: Path) -> Raster:
    """Read a raster of one band, such as an elevation model, with everything that the file states of its pixels and units.

    Raises InputError for a damaged file, one with too many pixels (`most_pixels`), or an unusable place or unit.
    """
    values, tags, notes = _measured(path)
    place = georeference(tags, (values.shape[0], values.shape[1]), path)
    return Raster(values[::-1] if place.flipped else values, place, notes)


def read_geotiff(path: Path) -> tuple[NDArray[np.float32], Grid]:
    """Read a raster of one band, such as a difference map, from a GeoTIFF, in metres.

    Returns the values (h, w) float32, NaN without data, and the grid of the pixels. Stated units are converted. Raises
    InputError as `read_raster` does, and for a file that does not state where its pixels are.
    """
    raster = read_raster(path)
    if raster.place.grid is None:
        raise InputError(
            "the TIFF has no pixel scale and tie point, which say where it lies",
            where=str(path),
            remedy="export the raster as a GeoTIFF, with its coordinates",
        )
    metres = raster.place.vertical_m or 1.0
    return (raster.values if metres == 1.0 else raster.values * np.float32(metres)), raster.place.grid


def read_tiff(path: Path) -> NDArray[np.float32]:
    """Read an image of one band, such as a depth map, (h, w) float32, NaN without data, with rows as in the file.

    Where the pixels are is not read: TensorFlow reads images in its own threads, where PROJ, which knows the coordinate
    systems, crashes. Raises InputError for a damaged or too large file.
    """
    return _measured(path)[0]


def _measured(path: Path) -> tuple[NDArray[np.float32], dict[int, Any], tuple[str, ...]]:
    """Read the values (h, w) in the file's unit, NaN without data; the first page's tags; notes."""
    values, tags, masked = _read(path)
    stated = _nodata(tags, path)
    absent = values == stated if not np.isnan(stated) else np.zeros(values.shape, dtype=bool)
    absent |= masked
    usual, notes = _unstated_nodata(values, absent | np.isnan(values))
    values = np.where(absent | usual, np.float32(np.nan), values)
    scale, offset = scale_and_offset(tags, path)
    if (scale, offset) != (1.0, 0.0):
        values = (values * np.float64(scale) + offset).astype(np.float32)
    _check_values(values, path)
    return values, tags, notes


def _georeference(grid: Grid) -> list[tuple[int, int, int, Any, bool]]:
    """Return the GeoTIFF tags of a grid."""
    citation = f"{_CITATION}|"
    keys = [
        (1, 1, 1, 4),  # version 1, revision 1.1, four keys
        (MODEL_TYPE, 0, 1, _USER_DEFINED),
        (RASTER_TYPE, 0, 1, _PIXEL_IS_AREA),
        (_CITATION_KEY, _GEO_ASCII, len(citation), 0),
        (LINEAR_UNITS, 0, 1, _METRE),
    ]
    return [
        (PIXEL_SCALE, _DOUBLE, 3, (grid.gsd, grid.gsd, 0.0), False),
        (TIEPOINT, _DOUBLE, 6, (0.0, 0.0, 0.0, grid.x_min, grid.y_max, 0.0), False),
        (GEO_KEYS, _SHORT, 4 * len(keys), tuple(number for key in keys for number in key), False),
        (_GEO_ASCII, _ASCII, 0, citation, False),
        (_NODATA, _ASCII, 0, "nan", False),
    ]


def _write(
    path: Path,
    raster: NDArray[np.floating],
    description: str,
    tags: list[tuple[int, int, int, Any, bool]],
    *,
    with_mask: bool = False,
) -> None:
    """Write a TIFF without tifffile's metadata, software and date, so that equal rasters give equal bytes."""
    data = np.ascontiguousarray(raster, dtype=np.float32)
    plain: dict[str, Any] = {"metadata": None, "software": False}
    with writing(path) as temporary, tifffile.TiffWriter(temporary) as file:
        file.write(data, photometric="minisblack", description=description or None, extratags=tags, **plain)
        if with_mask:
            file.write(~np.isnan(data), photometric="mask", subfiletype=_MASK_PAGE, **plain)


def _read(path: Path) -> tuple[NDArray[np.float32], dict[int, Any], NDArray[np.bool_]]:
    """Read stored values (h, w), the first page's tags, and the pixels that a transparency mask leaves out."""
    check_file(path)
    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            _check_size(page, path)
            _check_parts(file, page)
            tags = {tag.code: tag.value for tag in page.tags}
            raster = page.asarray()
            masks = [each.asarray() for each in file.pages[1:3] if _is_mask(each, page)]
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror or error})",
            where=str(path),
            remedy="give the path of an existing TIFF that you may read",
        ) from None
    except (*_DAMAGE, tifffile.TiffFileError, zlib.error, lzma.LZMAError, struct.error) as error:
        raise _unreadable(path, " ".join(str(error).split())) from None
    if raster.ndim != 2 or raster.dtype.kind not in "fiub":
        raise InputError(
            f"the raster has the shape {raster.shape} and values of type {raster.dtype}",
            where=str(path),
            allowed="one band of numbers",
            remedy="export one band of the raster as float32",
        )
    with np.errstate(over="ignore"):  # becomes infinite, which is checked later
        values = raster.astype(np.float32, copy=False)
    masked = masks[0] == 0 if masks else np.zeros(values.shape, dtype=bool)
    return values, tags, masked


def _is_mask(page: Any, image: Any) -> bool:
    """Whether a page is the transparency mask of the image."""
    return bool(int(getattr(page, "subfiletype", 0)) & _MASK_PAGE) and page.shape == image.shape


def _unreadable(path: Path, problem: str) -> InputError:
    """Return the error for a file that tifffile cannot read; an unknown compression is not damage."""
    if "imagecodecs" in problem or "not supported" in problem or "not a known COMPRESSION" in problem:
        return InputError(
            f"the file uses a compression that cannot be read ({problem})",
            where=str(path),
            allowed="no compression, deflate, LZW, PackBits, LZMA, Zstandard, LERC, JPEG",
            remedy="save the raster with deflate or without compression",
        )
    return InputError(
        f"the file is not a complete TIFF file ({problem})",
        where=str(path),
        remedy="copy the complete file again, or export the raster again",
    )


def _unstated_nodata(values: NDArray[np.float32], absent: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Find pixels with a usual value for missing data that the file does not state, with a note.

    A value counts if no other value of the raster is half as far from zero: among heights of 100 to 900 m, -9999 is not a height.
    """
    for usual in _USUAL_NODATA:
        found = (values == usual) & ~absent
        if not found.any():
            continue
        others = values[~found & ~absent]
        if not len(others) or np.abs(others).max() > abs(float(usual)) / 2:
            continue
        return found, (f"{int(found.sum()):,} pixels of {usual:g} are read as missing data, although the file does not say so",)
    return np.zeros(values.shape, dtype=bool), ()


def _nodata(tags: dict[int, Any], path: Path) -> np.float32:
    """Return the value that stands for missing data, NaN if none is stated."""
    text = str(tags.get(_NODATA, "nan")).strip("\0 ") or "nan"
    try:
        return np.float32(text)
    except ValueError:
        raise InputError(
            f"the file states '{text[:40]}' as its value for missing data",
            where=str(path),
            allowed="a number",
            remedy="set the tag GDAL_NODATA to a number, for example with gdal_edit.py -a_nodata -9999",
        ) from None


def _check_values(raster: NDArray[np.float32], path: Path) -> None:
    """Raise InputError for infinite and huge values, by which some programs mark missing data."""
    known = np.isnan(raster) | (np.abs(raster) <= _LARGEST)
    if not known.all():
        raise InputError(
            f"the raster has {int((~known).sum()):,} pixels of infinite or huge values, such as {raster[~known][0]:g}",
            where=str(path),
            allowed=f"values up to {_LARGEST:g}",
            remedy="write NaN for missing data, or state the value in the tag GDAL_NODATA",
        )


def most_pixels() -> int:
    """Return the largest number of pixels that an image may have, so that a wrong file cannot fill the memory.

    It is MOST_PIXELS, or more if the environment variable SCARPSIM_READ_GB allows more GB, at four bytes a pixel.
    """
    return max(MOST_PIXELS, int(read_limit_gb() * 1e9 / 4))


def _check_size(page: tifffile.TiffPage, path: Path) -> None:
    """Raise InputError for an image that is too large, before memory is allocated."""
    pixels, depth = math.prod(page.shape), page.dtype.itemsize if page.dtype else 4
    if pixels > (most := most_pixels()):
        size = " x ".join(map(str, page.shape))
        raise InputError(
            f"the raster has {size} px, which take {pixels * depth / 1e9:.3g} GB of memory",
            where=str(path),
            allowed=f"at most {most:,} px",
            remedy=f"cut the raster into parts, export it with larger pixels, or set the variable {READ_LIMIT}",
        )


def _check_parts(file: tifffile.TiffFile, page: tifffile.TiffPage) -> None:
    """Raise ValueError for tiles or strips larger than their pixels, before memory is allocated."""
    most = math.prod(page.chunks) * (page.dtype.itemsize if page.dtype else 1)
    begin = _DECOMPRESSORS.get(int(page.compression))
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False):
        if count > 1.1 * most + _SLACK:
            raise ValueError(f"a part of {count:,} bytes for {most:,} bytes of pixels")
        if begin is None:
            continue
        file.filehandle.seek(offset)
        if len(begin().decompress(file.filehandle.read(count), most + _SLACK)) == most + _SLACK:
            raise ValueError(f"a part that becomes more than its {most:,} bytes of pixels")
