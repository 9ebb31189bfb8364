"""`scarpsim detect`: difference maps in, events out."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.config.bundled import configs_folder
from pipeline.detection.evaluation.detections import Detection
from pipeline.detection.inference import baseline
from pipeline.detection.network.data import CocoFolder
from pipeline.detection.products import events
from pipeline.detection.products.figures import write_overlay
from pipeline.detection.products.places import placed
from pipeline.formats.rasters.geotiff import read_geotiff, write_geotiff
from pipeline.report.progress import Progress
from scene.common.errors import InputError

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


def detector_folder(model: str) -> Path:
    """Where a detector lies: `default` (the weights that come with scarpsim), or a folder that `scarpsim train` made."""
    return configs_folder() / "detectors" / DEFAULT if model == DEFAULT else Path(model)


def detector(model: str, *, unmirrored: bool = False) -> Detector:
    """By name: `baseline`, or as `detector_folder` has it; unmirrored: it does not look at mirror images of maps."""
    if model == BASELINE:
        if unmirrored:
            raise InputError(f"goes with a network, not with '{BASELINE}'", where="--unmirrored", remedy="leave it out")
        return baseline.detect
    from pipeline.detection.network.keras_backend import keras_ready

    keras_ready()
    from pipeline.detection.inference import inference, weights

    network = weights.load(detector_folder(model), unmirrored=unmirrored)
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
            folder = CocoFolder(place, masks=False)
            result += [Input(folder.path(image), image["file_name"], image) for image in folder.images]
            continue
        files = sorted(place.glob("difference_*.tif")) if place.is_dir() else [place]
        if not files:
            allowed = "a TIFF, a run folder, or a folder with annotations.json"
            raise InputError("holds no difference map", where=str(place), allowed=allowed)
        result += [Input(file, file.name, {"file_name": file.name}) for file in files]
    for path, count in Counter(item.path for item in result).items():
        if count > 1:
            raise InputError(f"is given {count} times", where=str(path), remedy="name each map once")
    result = _told_apart(result)
    own = [item.image.get("id") for item in result]
    if len(set(own)) < len(own) or None in own:
        result = [Input(item.path, item.name, {**item.image, "id": number}) for number, item in enumerate(result, start=1)]
    return result


def _told_apart(inputs: Sequence[Input]) -> list[Input]:
    """Maps of one file name, as those of two runs, with their folder before it, or with all of their path."""
    inputs = list(inputs)
    for longer in (lambda item: f"{item.path.parent.name}/{item.path.name}", lambda item: item.path.as_posix()):
        count = Counter(item.name for item in inputs)
        inputs = [item if count[item.name] == 1 else _renamed(item, longer(item)) for item in inputs]
    return inputs


def _renamed(item: Input, name: str) -> Input:
    return Input(item.path, name, {**item.image, "file_name": name})


def detect(
    model: str,
    places: Sequence[Path],
    out: Path,
    confidences: Sequence[float] = CONFIDENCES,
    pictures: bool = True,
    progress: Progress | None = None,
    *,
    unmirrored: bool = False,
) -> list[events.Event]:
    """Find the blocks in difference maps (GeoTIFF, m); returns the events at the lowest of the confidences.

    unmirrored: a network looks at maps as they are alone, which takes less time where its `head.mirrored` says otherwise.

    Writes to `out`: detections.json, everything above a score of 0.05, for `scarpsim evaluate`; for each confidence c
    detections_c.json and events_c.csv; for the lowest also a raster of masks and an overlay picture per map. Nothing is written
    before every map is searched.
    """
    inputs, progress = find_inputs(places), progress or Progress()
    with progress.stage("network"):
        find = detector(model, unmirrored=unmirrored)
    results: list[_Result] = []
    progress.plan({"detection": 1.0, "results": 0.2 if pictures else 0.01})
    with progress.stage("detection"):
        for number, item in enumerate(inputs, start=1):
            results.append(_searched(item, find, min(confidences)))
            progress.advance(number / len(inputs))
    with progress.stage("results"):
        _write(results, confidences, out)
        stems = _stems(results)
        for number, (result, stem) in enumerate(zip(results, stems, strict=True) if pictures else [], start=1):
            _write_pictures(result, min(confidences), out, stem)
            progress.advance(number / len(results))
    return [event for result in results for event in result.events]


@dataclass(frozen=True)
class _Result:
    """What was found in a map of `shape`, px, best first; events: of those from the lowest confidence on."""

    item: Input
    shape: tuple[int, ...]
    found: list[Detection]
    events: list[events.Event]


def _searched(item: Input, find: Detector, lowest: float) -> _Result:
    difference, grid = read_geotiff(item.path)
    found = find(difference)
    sure = [each for each in found if each.score >= lowest]
    told = [placed(events.event(each, count, item.name, difference, grid), item.path) for count, each in enumerate(sure, start=1)]
    return _Result(item, difference.shape, found, told)


def _write(results: Sequence[_Result], confidences: Sequence[float], out: Path) -> None:
    """The detections as COCO, all and from each confidence on, and the tables of events."""
    images = [{**each.item.image, "height": each.shape[0], "width": each.shape[1]} for each in results]
    pairs = [(image["id"], result.shape, each) for image, result in zip(images, results, strict=True) for each in result.found]
    annotations = [each.annotation(count, number, shape) for count, (number, shape, each) in enumerate(pairs, start=1)]
    told = [event for result in results for event in result.events]
    events.write_coco(images, annotations, out / "detections.json")
    for confidence in confidences:
        chosen = [each for each in annotations if each["score"] >= confidence]
        events.write_coco(images, chosen, out / f"detections_{confidence:g}.json")
        events.write_events([each for each in told if each.score >= confidence], out / f"events_{confidence:g}.csv")


def _stems(results: Sequence[_Result]) -> list[str]:
    """A file name for each map's pictures, its own where a file can have it, numbered where two would be alike."""
    stems: dict[str, None] = {}
    for result in results:
        stem = re.sub(r"[^\w.-]+", "_", result.item.name.rsplit(".", 1)[0])
        names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
        stems[next(name for name in names if name not in stems)] = None
    return list(stems)


def _write_pictures(result: _Result, lowest: float, out: Path, stem: str) -> None:
    """The raster of masks and the overlay of a map, which is read again: all maps together may not fit the memory."""
    difference, grid = read_geotiff(result.item.path)
    sure = [each for each in result.found if each.score >= lowest]
    write_geotiff(out / f"{stem}_masks.tif", events.label_raster(sure, difference.shape), grid)
    write_overlay(difference, grid, sure, out / f"{stem}_detections.png")
