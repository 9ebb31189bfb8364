"""Public reports about COCO annotations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask

from benchmarks.field_reports.report import Report, refused
from pipeline.detection.evaluation.evaluate import coco_metrics, evaluate
from pipeline.formats.records.coco import read_coco, read_detections

_HEIGHT, _WIDTH = 40, 60
_BOXES = ((2, 3, 10, 8), (20, 5, 12, 12), (40, 20, 9, 14))


def _mask(box: tuple[int, int, int, int]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    mask = np.zeros((_HEIGHT, _WIDTH), np.uint8)
    x, y, width, height = box
    mask[y : y + height, x : x + width] = 1
    return mask


def _polygon(box: tuple[int, int, int, int]) -> list[list[int]]:
    x, y, width, height = box
    return [[x, y, x + width, y, x + width, y + height, x, y + height]]


def _lengths(box: tuple[int, int, int, int]) -> list[int]:
    """Uncompressed run lengths of a mask, column by column, from zeros on."""
    flat = _mask(box).ravel(order="F")
    ends = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], ends, [len(flat)]]))
    return [int(run) for run in (runs if flat[0] == 0 else [0, *runs])]


def _annotations(first_id: int = 1, **changes: Any) -> list[dict[str, Any]]:
    return [
        {"id": first_id + place, "image_id": 0, "category_id": 1, "bbox": list(box), "area": box[2] * box[3], "iscrowd": 0}
        | {"segmentation": _polygon(box)}
        | {key: change(box) for key, change in changes.items()}
        for place, box in enumerate(_BOXES)
    ]


def _truth(folder: Path, annotations: list[dict[str, Any]]) -> Path:
    images = [{"id": 0, "file_name": "a.tif", "width": _WIDTH, "height": _HEIGHT}]
    document = {"images": images, "categories": [{"id": 1, "name": "block"}], "annotations": annotations}
    (folder / "truth.json").write_text(json.dumps(document))
    return folder / "truth.json"


def _areas(path: Path) -> list[int]:
    return [int(coco_mask.area(entry["segmentation"])) for entry in read_coco(path).annotations]


def _scored(folder: Path, annotations: list[dict[str, Any]]) -> str:
    """Score detections that are the truth: every figure has to be 1."""
    truth = read_coco(_truth(folder, annotations))
    (folder / "found.json").write_text(json.dumps([{**entry, "score": 0.97} for entry in _annotations()]))
    found = read_detections(folder / "found.json", truth)
    scores = evaluate(truth.to_dict(), found)
    least = min(score.f1 for score in scores if score.confidence < 0.97)
    average = coco_metrics(truth.to_dict(), found)["AP"]
    assert least == 1.0, f"F1 {least}"
    assert average > 0.999, f"COCO's AP {average}"
    return "F1 1 and COCO's AP 1 for detections that are the truth"


def _ids_from_0(folder: Path) -> str:
    return _scored(folder, _annotations(first_id=0))


def _no_area(folder: Path) -> str:
    annotations = _annotations()
    for entry in annotations:
        del entry["area"], entry["iscrowd"]
    return _scored(folder, annotations)


def _uncompressed(folder: Path) -> str:
    path = _truth(folder, _annotations(segmentation=lambda box: {"size": [_HEIGHT, _WIDTH], "counts": _lengths(box)}))
    assert _areas(path) == [box[2] * box[3] for box in _BOXES]
    return "reads the masks: areas are right"


def _compressed(folder: Path) -> str:
    def packed(box: tuple[int, int, int, int]) -> dict[str, Any]:
        encoded = coco_mask.encode(np.asfortranarray(_mask(box)))
        return {"size": encoded["size"], "counts": encoded["counts"].decode()}

    path = _truth(folder, _annotations(segmentation=packed))
    assert _areas(path) == [box[2] * box[3] for box in _BOXES]
    return "reads the masks: areas are right"


def _other_size(folder: Path) -> str:
    def turned(box: tuple[int, int, int, int]) -> dict[str, Any]:
        return {"size": [_WIDTH, _HEIGHT], "counts": _lengths(box)}

    path = _truth(folder, _annotations(segmentation=turned))
    return refused(lambda: read_coco(path), folder, "60", "40")


def _bytes_as_text(folder: Path) -> str:
    def printed(box: tuple[int, int, int, int]) -> dict[str, Any]:
        encoded = coco_mask.encode(np.asfortranarray(_mask(box)))
        return {"size": encoded["size"], "counts": str(encoded["counts"])}

    path = _truth(folder, _annotations(segmentation=printed))
    return refused(lambda: read_coco(path), folder, "run lengths cannot be decoded")


REPORTS = (
    Report("cvat-ai/cvat#748", "annotations numbered from 0", "count the first one as any other", _ids_from_0),
    Report("cocodataset/cocoapi#546", "annotations without areas", "take the masks' areas", _no_area),
    Report("cocodataset/cocoapi#33", "run lengths as a list of numbers", "read the masks", _uncompressed),
    Report("talmolab/sleap-io#487", "run lengths as compressed text", "read the masks", _compressed),
    Report("cocodataset/cocoapi#488", "a mask whose size is not the picture's", "refuse it", _other_size),
    Report("cocodataset/cocoapi#362", "run lengths printed with `b'...'` around them", "refuse it", _bytes_as_text),
)
