"""`scarpsim evaluate`: files in, tables out."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.detect.evaluate import CONFIDENCES, Overlap, Score, coco_metrics, evaluate
from pipeline.formats.atomic import write_json, write_text
from scene.errors import InputError, nearest


@dataclass(frozen=True)
class Assessment:
    """Scores of every group and pycocotools' figures over all images."""

    scores: list[Score]
    coco: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """JSON types."""
        return {"scores": [score.to_dict() for score in self.scores], "coco": self.coco}


def assess(
    truth: Path,
    predictions: Path,
    keys: Sequence[str] = (),
    kind: Overlap = "segm",
    confidences: Sequence[float] = CONFIDENCES,
) -> Assessment:
    """Compare two COCO files; `keys` of the truth's images, such as noise or wall, make the groups.

    kind: overlap of masks or of boxes; confidences: lowest scores that count, each a column of the tables.

    Predictions that list their images are joined by file name, others (pycocotools' plain list) by image id. Raises InputError
    for files that are not COCO, predictions without scores, and images that the truth does not have.
    """
    path = truth / "annotations.json" if truth.is_dir() else truth
    reference, found = _read(path), _read(predictions)
    if not isinstance(reference, dict) or not reference.get("images"):
        raise InputError("names no image", where=str(path), remedy="give the COCO annotations of the same maps")
    items = _joined(reference, found, str(predictions))
    scores = evaluate(reference, items, _groups(reference, keys, str(path)), confidences, kind=kind)
    return Assessment(scores, coco_metrics(reference, items, kind))


def as_text(assessment: Assessment) -> str:
    """Tables in the form of the thesis's, one per group, and COCO's figures."""
    lines = []
    groups: dict[str, list[Score]] = {}
    for score in assessment.scores:
        groups.setdefault(score.group, []).append(score)
    for group, scores in groups.items():
        lines += ["", group, f"{'confidence':<12}" + "".join(f"{_probability(score.confidence):>9}" for score in scores)]
        lines.append(f"{'IoU':<12}" + "".join(f"{score.iou:>9.2f}" for score in scores))
        for title, name in (("TP", "true_positives"), ("FP", "false_positives"), ("FN", "false_negatives")):
            lines.append(f"{title:<12}" + "".join(f"{getattr(score, name):>9}" for score in scores))
        for title, name in (("precision", "precision"), ("recall", "recall"), ("F1", "f1"), ("area ratio", "area_ratio")):
            lines.append(f"{title:<12}" + "".join(_cell(getattr(score, name)) for score in scores))
    coco = "  ".join(f"{name} {value:.3f}" for name, value in assessment.coco.items() if value >= 0)
    return "\n".join([*lines[1:], "", f"COCO: {coco}"])


def write(assessment: Assessment, folder: Path) -> None:
    """scores.json and scores.csv."""
    write_json(folder / "scores.json", assessment.to_dict())
    text = io.StringIO()
    rows = [score.to_dict() for score in assessment.scores]
    table = csv.DictWriter(text, rows[0], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_text(folder / "scores.csv", text.getvalue())


def _probability(value: float) -> str:
    """With two decimals, or more where it has more."""
    return max(f"{value:.2f}", f"{value:g}", key=len)


def _cell(value: float) -> str:
    return f"{'-':>9}" if np.isnan(value) else f"{value:>8.1%} "


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    except ValueError as error:
        raise InputError(f"is not JSON ({error})", where=str(path), remedy="make it again") from None


def _joined(truth: Mapping[str, Any], found: Any, where: str) -> list[dict[str, Any]]:
    """The predictions with the truth's image ids."""
    items = found.get("annotations") if isinstance(found, dict) else found
    if not isinstance(items, list) or not all(isinstance(item, dict) and "image_id" in item for item in items):
        raise InputError("is no list of COCO detections", where=where, remedy="give a detections.json of scarpsim detect")
    if any("score" not in item for item in items):
        raise InputError("has annotations without a score", where=where, remedy="give detections, not the truth")
    known = {image["file_name"]: image["id"] for image in truth["images"]}
    ids = {number: number for number in known.values()}
    if isinstance(found, dict):
        ids = {image["id"]: known[image["file_name"]] for image in found.get("images", []) if image["file_name"] in known}
    strange = {item["image_id"] for item in items} - set(ids)
    if strange:
        problem = f"has detections in {len(strange)} images that the truth does not have, such as id {min(strange)}"
        raise InputError(problem, where=where, remedy="compare with the annotations of the same maps")
    return [{**item, "image_id": ids[item["image_id"]]} for item in items]


def _groups(truth: Mapping[str, Any], keys: Sequence[str], where: str) -> dict[str, list[int]]:
    images = truth["images"]
    groups: dict[str, list[int]] = {"all": [image["id"] for image in images]}
    for key in keys:
        if not all(key in image for image in images):
            known = sorted(set.intersection(*(set(image) for image in images)))
            raise InputError(f"the images have no '{key}'", where=where, allowed=", ".join(known), remedy=nearest(key, known))
        for value in sorted({image[key] for image in images}, key=str):
            groups[f"{key} {value}"] = [image["id"] for image in images if image[key] == value]
    return groups
