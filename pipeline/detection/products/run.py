"""Run `scarpsim detect`: read difference maps, detect blocks, write events."""

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
from pipeline.detection.products.places import with_world_coordinates
from pipeline.formats.rasters.geotiff import read_geotiff, write_geotiff
from pipeline.report.progress import Progress
from scene.common.errors import InputError

BASELINE, DEFAULT = "baseline", "default"
"""Names of the detectors that need no folder."""
CONFIDENCES = (0.9, 0.95, 0.99)
"""Default confidences of the output files."""
LOWEST_SCORE = 0.05
"""Lowest score of a detection that is kept."""
Detector = Callable[[NDArray[np.float32]], list[Detection]]


@dataclass(frozen=True)
class InputMap:
    """A difference map in which to detect blocks.

    path: its file. name: its name in the outputs. image: its entry in COCO's list of images, with an id.
    """

    path: Path
    name: str
    image: dict[str, Any]


def detector_folder(model: str) -> Path:
    """Return the folder of a detector: `default` (the weights that come with scarpsim), or one made by `scarpsim train`."""
    return configs_folder() / "detectors" / DEFAULT if model == DEFAULT else Path(model)


def detector(model: str, *, mirrored: bool = False) -> Detector:
    """Load a detector as a function from a difference map (h, w), m, NaN without data, to its detections, best first.

    model: `baseline` (a threshold), `default` (the weights that come with scarpsim), or a folder made by `scarpsim train`.
    mirrored: whether it also searches mirror images of the map, as its config says. Raises InputError if it cannot be loaded.
    """
    if model == BASELINE:
        if mirrored:
            raise InputError(
                f"the option needs a neural network as detector, not '{BASELINE}'",
                where="--mirrored",
                remedy="leave the option out",
            )
        return baseline.detect
    from pipeline.detection.network.keras_backend import import_keras

    import_keras()
    from pipeline.detection.inference import inference, weights

    network = weights.load(detector_folder(model), mirrored=mirrored)
    return lambda difference: inference.detect(network, difference, LOWEST_SCORE)


def sorted_confidences(values: Sequence[float]) -> tuple[float, ...]:
    """Return the confidences (smallest scores) at which detections are written, in rising order without repetition.

    values: those that the user gives. Raises InputError unless they are between 0.05, the lowest score of a detection, and 1.
    """
    for value in values:
        if not LOWEST_SCORE <= value <= 1:
            raise InputError(
                f"the confidence is {value:g}",
                where="--confidence",
                allowed=f"{LOWEST_SCORE:g} to 1",
                remedy="write 0.95 for 95 %",
            )
    return tuple(sorted(set(values)))


def find_inputs(places: Sequence[Path]) -> list[InputMap]:
    """Find the difference maps in which to detect blocks.

    places: TIFF files, folders with annotations.json, or run folders. The maps' ids are those of annotations.json, or count
    from 1.
    """
    result: list[InputMap] = []
    for place in places:
        if (place / "annotations.json").is_file():
            folder = CocoFolder(place, masks=False)
            result += [InputMap(folder.path(image), image["file_name"], image) for image in folder.images]
            continue
        files = sorted(place.glob("difference_*.tif")) if place.is_dir() else [place]
        if not files:
            raise InputError(
                "no difference map found",
                where=str(place),
                allowed="a TIFF, a run folder, or a folder with annotations.json",
                remedy="name a difference map, or a folder that contains some",
            )
        result += [InputMap(file, file.name, {"file_name": file.name}) for file in files]
    for path, count in Counter(item.path for item in result).items():
        if count > 1:
            raise InputError(f"the map is given {count} times", where=str(path), remedy="name each map once")
    result = _unique_names(result)
    own = [item.image.get("id") for item in result]
    if len(set(own)) < len(own) or None in own:
        result = [InputMap(item.path, item.name, {**item.image, "id": number}) for number, item in enumerate(result, start=1)]
    return result


def _unique_names(inputs: Sequence[InputMap]) -> list[InputMap]:
    """Give maps with the same file name, such as those of two runs, unique names: with their folder, or with their whole path."""
    inputs = list(inputs)
    for longer in (lambda item: f"{item.path.parent.name}/{item.path.name}", lambda item: item.path.as_posix()):
        count = Counter(item.name for item in inputs)
        inputs = [item if count[item.name] == 1 else _renamed(item, longer(item)) for item in inputs]
    return inputs


def _renamed(item: InputMap, name: str) -> InputMap:
    """Return the input with another name."""
    return InputMap(item.path, name, {**item.image, "file_name": name})


def detect(
    model: str,
    places: Sequence[Path],
    out: Path,
    confidences: Sequence[float] = CONFIDENCES,
    pictures: bool = True,
    progress: Progress | None = None,
    *,
    mirrored: bool = False,
) -> list[events.Event]:
    """Detect blocks in difference maps and write the results.

    Nothing is written before all maps are searched. The files are detections.json with everything above a score of 0.05, for
    `scarpsim evaluate`; detections_c.json and events_c.csv for each confidence c; and for the lowest one a raster of masks and a
    picture of each map.

    Parameters
    ----------
    model : Name of the detector, as in `detector`.
    places : Difference maps (GeoTIFF, m) or folders of them.
    out : Folder to write.
    confidences : Lowest scores of the output files.
    pictures : Whether to write masks and pictures.
    progress : Receives the progress; None: nothing is shown.
    mirrored : Whether a network also searches the mirrored views of `head.mirrored`, which takes more time.

    Returns
    -------
    The events at the lowest confidence.
    """
    inputs, progress = find_inputs(places), progress or Progress()
    with progress.stage("network"):
        find = detector(model, mirrored=mirrored)
    results: list[_Result] = []
    progress.plan({"detection": 1.0, "results": 0.2 if pictures else 0.01})
    with progress.stage("detection"):
        for number, item in enumerate(inputs, start=1):
            results.append(_search(item, find, min(confidences)))
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
    """Detections in a map.

    Attributes
    ----------
    item : The map.
    shape : (h, w) of the map, px.
    found : All detections, best first.
    events : Events of those from the lowest confidence.
    """

    item: InputMap
    shape: tuple[int, ...]
    found: list[Detection]
    events: list[events.Event]


def _search(item: InputMap, find: Detector, lowest: float) -> _Result:
    """Detect blocks in a map and measure their events."""
    difference, grid = read_geotiff(item.path)
    found = find(difference)
    sure = [each for each in found if each.score >= lowest]
    told = [
        with_world_coordinates(events.event(each, count, item.name, difference, grid), item.path)
        for count, each in enumerate(sure, start=1)
    ]
    return _Result(item, difference.shape, found, told)


def _write(results: Sequence[_Result], confidences: Sequence[float], out: Path) -> None:
    """Write detections and events, all and from each confidence."""
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
    """Return a unique file name for each map's pictures, its own name where possible."""
    stems: dict[str, None] = {}
    for result in results:
        stem = re.sub(r"[^\w.-]+", "_", result.item.name.rsplit(".", 1)[0])
        names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
        stems[next(name for name in names if name not in stems)] = None
    return list(stems)


def _write_pictures(result: _Result, lowest: float, out: Path, stem: str) -> None:
    """Write the raster of masks and the picture of a map; the map is read again, as all together may not fit the memory."""
    difference, grid = read_geotiff(result.item.path)
    sure = [each for each in result.found if each.score >= lowest]
    write_geotiff(out / f"{stem}_masks.tif", events.label_raster(sure, difference.shape), grid)
    write_overlay(difference, grid, sure, out / f"{stem}_detections.png")
