"""`scarpsim detect`: difference maps in, events out."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.bundled import configs_folder
from pipeline.detect import baseline, events
from pipeline.detect.data import CocoFolder
from pipeline.detect.detections import Detection
from pipeline.detect.figures import write_overlay
from pipeline.formats.geotiff import read_geotiff, write_geotiff
from pipeline.progress import Progress
from scene.errors import InputError

BASELINE, DEFAULT = "baseline", "default"
CONFIDENCES = (0.9, 0.95, 0.99)
LOWEST_SCORE = 0.05
Detector = Callable[[NDArray[np.float32]], list[Detection]]


@dataclass(frozen=True)
class Input:
    """A difference map. name: as in the outputs; image: its entry in COCO's list, with an id."""

    path: Path
    name: str
    image: dict[str, Any]


def detector(model: str) -> Detector:
    """By name: `baseline`, `default` (the weights that come with scarpsim), or a folder that `scarpsim train` made."""
    if model == BASELINE:
        return baseline.detect
    folder = configs_folder() / "detectors" / DEFAULT if model == DEFAULT else Path(model)
    from pipeline.detect import inference, weights

    network = weights.load(folder)
    return lambda difference: inference.detect(network, difference, LOWEST_SCORE)


def checked_confidences(values: Sequence[float]) -> tuple[float, ...]:
    """The values in rising order, each once; raises InputError where one is no probability above the lowest that is kept."""
    for value in values:
        if not LOWEST_SCORE <= value <= 1:
            raise InputError(
                f"got {value:g}", where="--confidence", allowed=f"{LOWEST_SCORE:g} to 1", remedy="write 0.95 for 95 %"
            )
    return tuple(sorted(set(values)))


def find_inputs(places: Sequence[Path]) -> list[Input]:
    """The difference maps at some paths: TIFF files, folders with annotations.json, run folders; ids from 1, or COCO's."""
    result: list[Input] = []
    for place in places:
        if (place / "annotations.json").is_file():
            result += [Input(place / image["file_name"], image["file_name"], image) for image in CocoFolder(place).images]
            continue
        files = sorted(place.glob("difference_*.tif")) if place.is_dir() else [place]
        if not files:
            allowed = "a TIFF, a run folder, or a folder with annotations.json"
            raise InputError("holds no difference map", where=str(place), allowed=allowed)
        result += [Input(file, file.name, {"file_name": file.name}) for file in files]
    own = [item.image.get("id") for item in result]
    if len(set(own)) < len(own) or None in own:
        result = [Input(item.path, item.name, {**item.image, "id": number}) for number, item in enumerate(result, start=1)]
    return result


def detect(
    model: str,
    places: Sequence[Path],
    out: Path,
    confidences: Sequence[float] = CONFIDENCES,
    pictures: bool = True,
    progress: Progress | None = None,
) -> list[events.Event]:
    """Find the blocks in difference maps (GeoTIFF, m); returns the events at the lowest of the confidences.

    Writes to `out`: detections.json, everything above a score of 0.05, for `scarpsim evaluate`; for each confidence c
    detections_c.json and events_c.csv; for the lowest also a raster of masks and an overlay picture per map.
    """
    inputs, progress = find_inputs(places), progress or Progress()
    with progress.stage("network"):
        find = detector(model)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    found_events: list[events.Event] = []
    progress.plan({"detection": 1.0})
    with progress.stage("detection"):
        for number, item in enumerate(inputs):
            difference, grid = read_geotiff(item.path)
            found = find(difference)
            images.append({**item.image, "height": difference.shape[0], "width": difference.shape[1]})
            annotations += [
                each.annotation(len(annotations) + count, images[-1]["id"], difference.shape)
                for count, each in enumerate(found, start=1)
            ]
            sure = [each for each in found if each.score >= min(confidences)]
            found_events += [events.event(each, count, item.name, difference, grid) for count, each in enumerate(sure, start=1)]
            if pictures:
                stem = re.sub(r"[^\w.-]+", "_", item.name.rsplit(".", 1)[0])
                write_geotiff(out / f"{stem}_masks.tif", events.label_raster(sure, difference.shape), grid)
                write_overlay(difference, grid, sure, out / f"{stem}_detections.png")
            progress.advance((number + 1) / len(inputs))
        events.write_coco(images, annotations, out / "detections.json")
        for confidence in confidences:
            chosen = [each for each in annotations if each["score"] >= confidence]
            events.write_coco(images, chosen, out / f"detections_{confidence:g}.json")
            events.write_events([each for each in found_events if each.score >= confidence], out / f"events_{confidence:g}.csv")
    return found_events
