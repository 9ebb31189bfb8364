"""Run `scarpsim evaluate`: read truth and detections, write tables of scores."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.change.annotate import DETECTABLE_SNR
from pipeline.detection.evaluation.evaluate import CONFIDENCES, Overlap, Score, coco_metrics, evaluate
from pipeline.detection.evaluation.reliability import EDGES, OVERLAP, Reliability, reliability
from pipeline.detection.products.figures import write_reliability
from pipeline.formats.files.atomic import write_json, write_text
from pipeline.formats.records.coco import Coco, Entry, read_coco, read_detections
from scene.common.errors import InputError, nearest

_MOST_PAIRS = 25_000_000
"""Largest number of pairs of an annotation and a detection in one image; their overlaps take 200 MB."""
_KINDS: dict[Overlap, str] = {"segm": "masks", "bbox": "boxes"}
"""Name of each overlap."""


@dataclass(frozen=True)
class Assessment:
    """Scores of a detector on annotated images.

    Attributes
    ----------
    scores : Scores of every group of images, by overlap of masks and of boxes.
    coco : pycocotools' metrics over all images, by overlap of masks, or of boxes if there are no masks.
    reliability : How well the detector's scores agree with the share of blocks, by the same kind of overlap as `coco`.
    """

    scores: list[Score]
    coco: dict[str, float]
    reliability: list[Reliability]

    def to_dict(self) -> dict[str, Any]:
        """Return the scores of the detector as JSON types, for scores.json."""
        scores, reliable = ([each.to_dict() for each in found] for found in (self.scores, self.reliability))
        return {"scores": scores, "coco": self.coco, "reliability": reliable}


def assess(
    truth: Path,
    predictions: Path,
    keys: Sequence[str] = (),
    kinds: Sequence[Overlap] = ("segm", "bbox"),
    confidences: Sequence[float] = CONFIDENCES,
) -> Assessment:
    """Score a COCO file of detections against one of the truth.

    Parameters
    ----------
    truth : annotations.json, or its folder.
    predictions : File of detections.
    keys : Keys of the truth's images, such as noise or wall; images with the same value of a key are also scored as a group.
    kinds : Overlap by which detections are matched: of masks ("segm"), of boxes ("bbox"), or both.
    confidences : Lowest scores that count, each a column of the tables.

    Raises
    ------
    InputError
        If a file is wrong, as in `read_coco` and `read_detections`, or images lack a key.
    """
    path = truth / "annotations.json" if truth.is_dir() else truth
    reference = read_coco(path, masks="segm" in kinds)
    found = read_detections(predictions, reference, masks="segm" in kinds)
    _check_pairs(reference.annotations, found, str(predictions))
    groups = _groups(reference.images, keys, str(path))
    scores = [score for kind in kinds for score in evaluate(reference.to_dict(), found, groups, confidences, kind=kind)]
    scores += _of_categories(reference, found, kinds, confidences)
    reliable = reliability(reference.to_dict(), found, groups, kinds[0])
    return Assessment(scores, coco_metrics(reference.to_dict(), found, kinds[0]), reliable)


def _of_categories(truth: Coco, found: list[Entry], kinds: Sequence[Overlap], confidences: Sequence[float]) -> list[Score]:
    """Score each category over all images; nothing if there is only one."""
    if len(truth.categories) < 2:
        return []
    result = []
    for category in truth.categories:
        number, group = category["id"], f"category {category.get('name', category['id'])}"
        own = [[each for each in entries if each["category_id"] == number] for entries in (truth.annotations, found)]
        reference = {**truth.to_dict(), "annotations": own[0]}
        images = {group: [image["id"] for image in truth.images]}
        result += [score for kind in kinds for score in evaluate(reference, own[1], images, confidences, kind=kind)]
    return result


def _check_pairs(truth: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]], where: str) -> None:
    """Raise InputError if an image has so many annotations and detections that their overlaps take gigabytes."""
    annotated, detected = (Counter(each["image_id"] for each in entries) for entries in (truth, found))
    for image, count in detected.items():
        if count * annotated[image] > _MOST_PAIRS:
            raise InputError(
                f"image {image} has {count:,} detections and {annotated[image]:,} true blocks, too many to compare each pair",
                where=where,
                allowed=f"{_MOST_PAIRS:,} pairs of a detection and a block",
                remedy="cut the image into tiles, or leave out the detections with the lowest scores",
            )


def as_text(assessment: Assessment) -> str:
    """Return the scores of a detector as text: a table for each group of images and kind of overlap, and COCO's metrics."""
    lines = []
    groups: dict[tuple[str, Overlap], list[Score]] = {}
    for score in assessment.scores:
        groups.setdefault((score.group, score.kind), []).append(score)
    by_group = sorted(groups.items(), key=lambda item: [name for name, _ in groups].index(item[0][0]))
    for (group, kind), scores in by_group:
        lines += [
            "",
            f"{group}, IoU of {_KINDS[kind]}",
            f"{'confidence':<12}" + "".join(f"{_probability(score.confidence):>9}" for score in scores),
        ]
        lines.append(f"{'IoU':<12}" + "".join(f"{score.iou:>9.2f}" for score in scores))
        for title, name in (("TP", "true_positives"), ("FP", "false_positives"), ("FN", "false_negatives")):
            lines.append(f"{title:<12}" + "".join(f"{getattr(score, name):>9}" for score in scores))
        for title, name in (("precision", "precision"), ("recall", "recall"), ("F1", "f1"), ("area ratio", "area_ratio")):
            lines.append(f"{title:<12}" + "".join(_cell(getattr(score, name)) for score in scores))
        if kind == by_group[0][0][1] and not np.isnan(scores[0].stand_out):
            lines.append(f"blocks that stand out from the noise (S/N > {DETECTABLE_SNR:g}): {100 * scores[0].stand_out:.1f} %")
    lines += ["", *_reliability_table(assessment.reliability)]
    coco = "  ".join(f"{name} {value:.3f}" for name, value in assessment.coco.items() if value >= 0)
    return "\n".join([*lines[1:], "", f"COCO: {coco}"])


def _reliability_table(groups: Sequence[Reliability]) -> Iterator[str]:
    """Yield the lines of the reliability table: the share of blocks in each class of scores, one line for each group."""
    yield f"share of blocks among the detections, by score ({_KINDS[groups[0].kind]}, IoU from {OVERLAP:g})"
    heads = [f"{low:g}-{high:g}" for low, high in pairwise(EDGES)]
    width = max(len(each.group) for each in groups) + 2
    yield " " * width + "".join(f"{head:>11}" for head in heads)
    for each in groups:
        shares = {one.low: one.precision for one in each.classes}
        yield f"{each.group:<{width}}" + "".join(f"  {_cell(shares.get(low, float('nan')))}" for low in EDGES[:-1])


def write(assessment: Assessment, folder: Path) -> None:
    """Write the scores of a detector to a folder: scores.json, scores.csv and the figure reliability.png."""
    write_reliability(assessment.reliability, folder / "reliability.png")
    write_json(folder / "scores.json", assessment.to_dict())
    text = io.StringIO()
    rows = [score.to_dict() for score in assessment.scores]
    table = csv.DictWriter(text, rows[0], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_text(folder / "scores.csv", text.getvalue())


def _probability(value: float) -> str:
    """Format a probability with two decimals, or more if it has more."""
    return max(f"{value:.2f}", f"{value:g}", key=len)


def _cell(value: float) -> str:
    """Format a share for a table."""
    return f"{'-':>9}" if np.isnan(value) else f"{100 * value:>7.1f} %"


def _groups(images: Sequence[Mapping[str, Any]], keys: Sequence[str], where: str) -> dict[str, list[int]]:
    """Group images by the values of keys; raise InputError for a key that images lack."""
    groups: dict[str, list[int]] = {"all": [image["id"] for image in images]}
    for key in keys:
        known = [name for name in sorted(set.intersection(*map(set, images))) if all(_is_word(image[name]) for image in images)]
        if key not in known:
            raise InputError(
                f"the images' '{key}' is not a word or number"
                if any(key in image for image in images)
                else f"the images have no '{key}'",
                where=where,
                allowed=", ".join(known),
                remedy=nearest(key, known) or "choose another key with --by",
            )
        for value in sorted({image[key] for image in images}, key=str):
            groups[f"{key} {value}"] = [image["id"] for image in images if image[key] == value]
    return groups


def _is_word(value: Any) -> bool:
    """Whether a value can name a group."""
    return isinstance(value, str | int | float | bool | None)
