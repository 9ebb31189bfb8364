"""Detections as people use them: a table of events with volumes in the wall's coordinates, a raster of masks, COCO files."""

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
    """One rockfall. x_m, y_m: centre of its mask in the map's frame, the wall's; depth_m: largest; volume_m3: over the mask.

    Depth and volume are those of the difference map, along the wall's normal; pixels without data count with the mean depth.
    world_x_m ...: the rock's place before it fell, in the survey's coordinates, NaN where they are not known.
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
"""Columns that older tables lack, and that are empty where the place is not known."""


def event(item: Detection, number: int, image: str, difference: NDArray[np.float32], grid: Grid) -> Event:
    """The event behind a detection in the difference map (h, w), m."""
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
    """A CSV table, one line per event, metres with 4 decimals, what is not known left empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(Event.__dataclass_fields__)
    for item in events:
        table.writerow([_written(value) for value in asdict(item).values()])
    write_text(path, text.getvalue())


def _written(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return "" if math.isnan(value) else f"{value:.4f}"


def read_events(path: Path) -> list[Event]:
    """A table that `write_events` wrote; raises InputError for a file that is none, naming the line."""
    remedy = "run scarpsim detect again"
    table = csv.DictReader(io.StringIO(read_text(path, remedy=remedy)))
    names = [field.name for field in fields(Event)]
    found: list[Event] = []
    try:
        for row in table:
            if list(row) not in (names, [name for name in names if name not in _PLACE]):
                raise InputError("is no table of events", where=str(path), allowed=f"columns {', '.join(names)}", remedy=remedy)
            found.append(_ROW.validate_python({name: value for name, value in row.items() if value or name not in _PLACE}))
    except csv.Error as error:
        raise InputError(f"is no table of events ({error})", where=str(path), remedy=remedy) from None
    except ValidationError as error:
        wrong = error.errors()[0]
        problem = f"'{wrong['loc'][0]}' is {wrong['input']!r:.80}"
        allowed = "finite numbers, and an image's name"
        raise InputError(problem, where=f"{path}, line {table.line_num}", allowed=allowed, remedy=remedy) from None
    return found


def label_raster(found: Sequence[Detection], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """(h, w) the number of the best detection at each pixel, counted from 1, NaN where there is none."""
    result = np.full(shape, np.nan, np.float32)
    for number, item in reversed(list(enumerate(found, start=1))):
        height, width = item.mask.shape
        view = result[item.row : item.row + height, item.column : item.column + width]
        view[item.mask] = number
    return result


def write_coco(images: Sequence[dict[str, Any]], annotations: Sequence[dict[str, Any]], path: Path) -> None:
    """Images and scored annotations as a COCO data set, which pycocotools loads; `annotations` alone is its result form."""
    write_json(path, {"images": images, "annotations": annotations, "categories": [BLOCK_CATEGORY]})
