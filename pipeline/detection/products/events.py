"""Write detections for users: a table of events with volumes and coordinates, a raster of masks, and COCO files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError

from pipeline.change.annotate import BLOCK_CATEGORY
from pipeline.detection.evaluation.detections import Detection
from pipeline.formats.files.atomic import write_json, write_text
from scene.common.errors import InputError
from scene.common.regular_file import read_text
from scene.geometry.grid import Grid


@dataclass(frozen=True)
class Event:
    """One detected rockfall.

    Depth and volume are those of the difference map along the wall's normal; pixels without data count with the mean depth.

    Attributes
    ----------
    image, number : Name of the map, and number of the event in it.
    x_m, y_m : Centre of the mask in the wall frame, m.
    width_m, height_m, area_m2 : Extent of the mask.
    depth_m, mean_depth_m : Largest and mean depth, m.
    volume_m3 : Volume over the mask, m^3.
    score : Confidence, 0 to 1.
    world_x_m, world_y_m, world_z_m : Place of the rock before it fell, in the survey's coordinates, m; NaN if unknown.
    """

    image: str
    number: int
    x_m: float
    y_m: float
    width_m: float
    height_m: float
    area_m2: float
    depth_m: float
    mean_depth_m: float
    volume_m3: float
    score: float
    world_x_m: float = float("nan")
    world_y_m: float = float("nan")
    world_z_m: float = float("nan")
    __pydantic_config__ = ConfigDict(allow_inf_nan=False)


_ROW = TypeAdapter(Event)
_PLACE = ("world_x_m", "world_y_m", "world_z_m")
"""Columns that older tables lack, and that are empty if the place is unknown."""


def event(item: Detection, number: int, image: str, difference: NDArray[np.float32], grid: Grid) -> Event:
    """Measure place, size and volume of a detected rockfall in its difference map.

    Parameters
    ----------
    item : The detection.
    number : Number of the event in its map.
    image : Name of the map.
    difference : (h, w) difference map, m.
    grid : Raster of the map.
    """
    height, width = item.mask.shape
    values = difference[item.row : item.row + height, item.column : item.column + width][item.mask]
    known = values[np.isfinite(values)].astype(np.float64)
    mean = float(known.mean()) if known.size else 0.0
    rows, columns = np.nonzero(item.mask)
    area = item.area_px * grid.gsd**2
    return Event(
        image=image,
        number=number,
        x_m=grid.x_min + (item.column + float(columns.mean()) + 0.5) * grid.gsd,
        y_m=grid.y_max - (item.row + float(rows.mean()) + 0.5) * grid.gsd,
        width_m=width * grid.gsd,
        height_m=height * grid.gsd,
        area_m2=area,
        depth_m=float(known.max()) if known.size else 0.0,
        mean_depth_m=mean,
        volume_m3=mean * area,
        score=item.score,
    )


def write_events(events: Sequence[Event], path: Path) -> None:
    """Write detected rockfalls to a CSV file, one line each, lengths in metres with 4 decimals, unknown values empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(Event.__dataclass_fields__)
    for item in events:
        table.writerow([_written(value) for value in asdict(item).values()])
    write_text(path, text.getvalue())


def _written(value: Any) -> Any:
    """Format a value for the table."""
    if not isinstance(value, float):
        return value
    return "" if math.isnan(value) else f"{value:.4f}"


def read_events(path: Path) -> list[Event]:
    """Read a CSV file of detected rockfalls that `write_events` wrote; raise InputError for any other file, naming the line."""
    remedy = "run scarpsim detect again on the same maps to write the table anew"
    table = csv.DictReader(io.StringIO(read_text(path, remedy=remedy)))
    names = [field.name for field in fields(Event)]
    found: list[Event] = []
    try:
        for row in table:
            if list(row) not in (names, [name for name in names if name not in _PLACE]):
                raise InputError(
                    "the file is not a table of events", where=str(path), allowed=f"columns {', '.join(names)}", remedy=remedy
                )
            found.append(_ROW.validate_python({name: value for name, value in row.items() if value or name not in _PLACE}))
    except csv.Error as error:
        raise InputError(f"the file is not a table of events ({error})", where=str(path), remedy=remedy) from None
    except ValidationError as error:
        wrong = error.errors()[0]
        raise InputError(
            f"the column '{wrong['loc'][0]}' has the value {wrong['input']!r:.80}",
            where=f"{path}, line {table.line_num}",
            allowed="finite numbers and an image's name",
            remedy=remedy,
        ) from None
    return found


def label_raster(found: Sequence[Detection], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Draw detections as a raster (h, w) for a GIS: the number of the best detection at a pixel, from 1; NaN where there is none.

    found: the detections, best first. shape: (h, w) of the map, px.
    """
    result = np.full(shape, np.nan, np.float32)
    for number, item in reversed(list(enumerate(found, start=1))):
        height, width = item.mask.shape
        view = result[item.row : item.row + height, item.column : item.column + width]
        view[item.mask] = number
    return result


def write_coco(images: Sequence[dict[str, Any]], annotations: Sequence[dict[str, Any]], path: Path) -> None:
    """Write detections as a COCO data set, which `scarpsim evaluate` reads.

    images: COCO's entries of the maps. annotations: COCO's entries of the detections, with scores, so that they are COCO
    results too. path: the JSON file.
    """
    write_json(path, {"images": images, "annotations": annotations, "categories": [BLOCK_CATEGORY]})
