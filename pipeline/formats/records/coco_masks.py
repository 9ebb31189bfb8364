"""Read masks in COCO's forms, polygons or run lengths, as compressed run lengths.

Everything is checked before pycocotools' C code, which accesses invalid memory if run lengths do not fit the image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from scene.common.errors import InputError

FORMS = "polygons [[x, y, x, y, x, y, ...], ...] or run lengths {size, counts}"
BEYOND_PX = 1.0
"""Distance by which points and boxes may be outside their image, px: some programs count the last pixel's far edge from one."""
_LONGEST_NUMBER = 7
"""Largest number of characters, of 5 bits each, of a run length."""


def run_lengths(segmentation: Any, height: int, width: int, where: str) -> dict[str, Any]:
    """Return the mask of a COCO annotation as compressed run lengths, the dictionary {size, counts} that pycocotools takes.

    Parameters
    ----------
    segmentation : The annotation's polygons or run lengths.
    height, width : Size of the image, px.
    where : Name of the annotation, for errors.

    Raises
    ------
    InputError
        If it is not a mask of that image.
    """
    if isinstance(segmentation, Mapping):
        return _checked(segmentation, height, width, where)
    if not isinstance(segmentation, Sequence) or isinstance(segmentation, str):
        raise InputError(
            f"the annotation's segmentation is {_kind(segmentation)}",
            where=where,
            allowed=FORMS,
            remedy="write the mask in one of these forms",
        )
    return _of_polygons(segmentation, height, width, where)


def _of_polygons(polygons: Sequence[Any], height: int, width: int, where: str) -> dict[str, Any]:
    """Draw polygons as a mask."""
    if not polygons:
        raise InputError(
            "the annotation's segmentation has no polygon", where=where, allowed=FORMS, remedy="leave the annotation out"
        )
    remedy = "draw the outline again, in pixels from the image's top-left corner"
    for number, polygon in enumerate(polygons, start=1):
        points = _numbers(polygon)
        if points is None or points.size < 6 or points.size % 2 or not np.isfinite(points).all():
            allowed = "x, y, x, y, ... of at least 3 points, finite numbers"
            raise InputError(
                f"polygon {number} of the annotation's segmentation is invalid", where=where, allowed=allowed, remedy=remedy
            )
        beyond = points.reshape(-1, 2) - (width, height)
        if points.min() < -BEYOND_PX or beyond.max() > BEYOND_PX:
            allowed = f"x from 0 to {width}, y from 0 to {height}"
            raise InputError(
                f"polygon {number} of the annotation's segmentation goes beyond the image",
                where=where,
                allowed=allowed,
                remedy=remedy,
            )
    merged = coco_mask.merge(coco_mask.frPyObjects([list(map(float, polygon)) for polygon in polygons], height, width))
    return {"size": [height, width], "counts": merged["counts"].decode("ascii")}


def _checked(segmentation: Mapping[str, Any], height: int, width: int, where: str) -> dict[str, Any]:
    """Check run lengths and compress them."""
    size, counts = segmentation.get("size"), segmentation.get("counts")
    if size != [height, width]:
        allowed = f"[{height}, {width}], the image's height and width"
        raise InputError(
            f"the image size of the annotation's segmentation (key `size`) is {_kind(size)}",
            where=where,
            allowed=allowed,
            remedy="use masks and images of the same data set",
        )
    lengths = _decompressed(counts) if isinstance(counts, str) else _plain(counts)
    if lengths is None or (lengths < 0).any() or lengths.sum() != height * width:
        allowed = f"run lengths, plain or as pycocotools compresses them, of {height * width} pixels in all"
        raise InputError(
            "the annotation's run lengths cannot be decoded",
            where=where,
            allowed=allowed,
            remedy="encode the mask again with pycocotools",
        )
    plain = {"size": [height, width], "counts": lengths.tolist()}
    counts = counts if isinstance(counts, str) else coco_mask.frPyObjects(plain, height, width)["counts"].decode("ascii")
    return {"size": [height, width], "counts": counts}


def _decompressed(counts: str) -> NDArray[np.int64] | None:
    """Return the run lengths in pycocotools' string; None if it is invalid.

    A character has 5 bits of a number, the lowest first, and a sixth bit that says that the number continues; the fifth bit of
    the last character is the sign. From the fourth number on, they are differences to the last but one (`rleFrString` of
    pycocotools' maskApi.c).
    """
    codes = np.frombuffer(counts.encode("utf-8"), np.uint8).astype(np.int64) - 48
    if not codes.size or codes.min() < 0 or codes.max() > 63 or codes[-1] & 32:
        return None
    ends = np.flatnonzero(codes & 32 == 0)
    starts = np.concatenate([[0], ends[:-1] + 1])
    characters = ends - starts + 1
    if characters.max() > _LONGEST_NUMBER:
        return None
    place = np.arange(codes.size) - np.repeat(starts, characters)
    numbers = np.add.reduceat((codes & 31) << (5 * place), starts)
    numbers -= np.where(codes[ends] & 16, 1 << (5 * characters), 0)
    numbers[1::2] = np.cumsum(numbers[1::2])
    numbers[2::2] = np.cumsum(numbers[2::2])
    return numbers


def _plain(counts: Any) -> NDArray[np.int64] | None:
    """Return a list of run lengths as an array; None if it is invalid."""
    values = _numbers(counts)
    return values.astype(np.int64) if values is not None and values.dtype.kind == "i" else None


def _numbers(values: Any) -> NDArray[Any] | None:
    """Return a list of numbers as an array (n,); None if it is not one."""
    if not isinstance(values, list) or not all(isinstance(value, int | float) for value in values):
        return None
    try:
        array = np.array(values)
    except (ValueError, OverflowError):
        return None
    return array if array.dtype.kind in "if" else None


def _kind(value: Any) -> str:
    """Return a value as a message shows it."""
    text = "missing" if value is None else repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
