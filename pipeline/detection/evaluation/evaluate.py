"""How good detections are: one-to-one matching, precision, recall, F1, mask areas, in the thesis's form; COCO's metrics beside.

The thesis calls the precision AP and the recall AR.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from pipeline.change.annotate import STANDS_OUT

CONFIDENCES, THRESHOLDS = (0.9, 0.95, 0.99), (0.25, 0.75)
Overlap = Literal["segm", "bbox"]
_KEYS = ("image_id", "category_id", "segmentation", "bbox", "area", "iscrowd", "score")


@dataclass(frozen=True)
class Score:
    """One cell of the thesis's tables.

    group: what the images or blocks have in common; confidence: lowest score that counts; iou: lowest overlap that counts;
    area_ratio: mean of predicted over true mask area of the matched, NaN where nothing matched; kind: overlap of masks or boxes;
    stand_out: share of the blocks whose niche stands out from the noise (pipeline/change/matched_filter.py), which is about the
    largest recall that any detector could reach; NaN where the annotations do not tell.
    """

    group: str
    confidence: float
    iou: float
    true_positives: int
    false_positives: int
    false_negatives: int
    area_ratio: float
    kind: Overlap = "segm"
    stand_out: float = float("nan")

    @property
    def precision(self) -> float:
        """Share of the detections that are blocks; NaN without detections."""
        return _share(self.true_positives, self.true_positives + self.false_positives)

    @property
    def recall(self) -> float:
        """Share of the blocks that were detected; NaN without blocks."""
        return _share(self.true_positives, self.true_positives + self.false_negatives)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; NaN where there is neither a block nor a detection."""
        return _share(2 * self.true_positives, 2 * self.true_positives + self.false_positives + self.false_negatives)

    def to_dict(self) -> dict[str, Any]:
        """JSON types; null for NaN."""
        values = {**asdict(self), "precision": self.precision, "recall": self.recall, "f1": self.f1}
        return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in values.items()}


def matches(overlap: NDArray[np.float64], threshold: float) -> NDArray[np.int64]:
    """(p,) index of the block that each prediction is matched to, -1 for none.

    overlap: (p, t) intersection over union, predictions by falling score. A prediction and a block are matched where each is
    the other's best and they overlap by `threshold` or more; of equal overlaps the earlier counts, so that each takes part in
    at most one match.
    """
    result = np.full(overlap.shape[0], -1)
    if 0 in overlap.shape:
        return result
    best, back = overlap.argmax(axis=1), overlap.argmax(axis=0)
    rows = np.arange(len(best))
    mutual = (back[best] == rows) & (overlap[rows, best] >= threshold)
    result[mutual] = best[mutual]
    return result


def evaluate(
    truth: Mapping[str, Any],
    predictions: Sequence[Mapping[str, Any]],
    groups: Mapping[str, Iterable[int]] | None = None,
    confidences: Sequence[float] = CONFIDENCES,
    thresholds: Sequence[float] = THRESHOLDS,
    kind: Overlap = "segm",
) -> list[Score]:
    """Scores of COCO predictions against COCO annotations, as `read_coco` gives them, for every group, confidence and overlap.

    groups: image ids by name; all images as one group by default. kind: overlap of masks or of boxes.
    """
    groups = groups or {"all": [image["id"] for image in truth["images"]]}
    blocks, found = _by_image(truth["annotations"]), _by_image(predictions)
    result = []
    for group, images in groups.items():
        images = list(images)
        bound = _stand_out([block for image in images for block in blocks.get(image, [])])
        for confidence in confidences:
            pairs = [_image_pairs(blocks.get(image, []), found.get(image, []), confidence, kind) for image in images]
            scores = (_score(group, confidence, threshold, pairs) for threshold in thresholds)
            result += [replace(score, kind=kind, stand_out=bound) for score in scores]
    return result


def matched_scores(
    truth: Mapping[str, Any],
    predictions: Sequence[Mapping[str, Any]],
    images: Iterable[int],
    threshold: float,
    kind: Overlap = "segm",
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(p,) scores of all predictions of some images, and whether each is matched to a block, as `evaluate` matches them all."""
    blocks, found = _by_image(truth["annotations"]), _by_image(predictions)
    scores: list[float] = []
    right: list[bool] = []
    for image in images:
        pairs = _image_pairs(blocks.get(image, []), found.get(image, []), 0.0, kind)
        scores += sorted((item["score"] for item in found.get(image, [])), reverse=True)
        right += list(matches(pairs.overlap, threshold) >= 0)
    return np.array(scores, dtype=np.float64), np.array(right, dtype=bool)


def coco_metrics(truth: Mapping[str, Any], predictions: Sequence[Mapping[str, Any]], kind: Overlap = "segm") -> dict[str, float]:
    """pycocotools' twelve figures (average precision and recall by overlap, area and count), by name; -1 where undefined."""
    names = (
        "AP",
        "AP50",
        "AP75",
        "AP_small",
        "AP_medium",
        "AP_large",
        "AR1",
        "AR10",
        "AR100",
        "AR_small",
        "AR_medium",
        "AR_large",
    )
    if not predictions:
        return dict.fromkeys(names, 0.0)
    with contextlib.redirect_stdout(io.StringIO()):
        reference = COCO()
        reference.dataset = {**truth, "annotations": _numbered(truth["annotations"])}
        reference.createIndex()
        assessment = COCOeval(reference, reference.loadRes(_numbered(predictions)), kind)
        assessment.evaluate()
        assessment.accumulate()
        assessment.summarize()
    return {name: float(value) for name, value in zip(names, assessment.stats, strict=True)}


def _numbered(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The entries with ids from 1, as COCOeval takes an id of 0 for no match, and without keys of others', such as captions."""
    return [{"id": number, **{key: entry[key] for key in _KEYS if key in entry}} for number, entry in enumerate(entries, start=1)]


@dataclass(frozen=True)
class _Pairs:
    """Predictions and blocks of one image. overlap: (p, t); areas: px."""

    overlap: NDArray[np.float64]
    predicted_area: NDArray[np.float64]
    true_area: NDArray[np.float64]


def _by_image(annotations: Iterable[Mapping[str, Any]]) -> dict[int, list[Mapping[str, Any]]]:
    result: dict[int, list[Mapping[str, Any]]] = {}
    for annotation in annotations:
        result.setdefault(annotation["image_id"], []).append(annotation)
    return result


def _image_pairs(blocks: list[Mapping[str, Any]], found: list[Mapping[str, Any]], confidence: float, kind: Overlap) -> _Pairs:
    chosen = sorted((item for item in found if item["score"] >= confidence), key=lambda item: -item["score"])
    areas = [np.array([float(item["area"]) for item in items]) for items in (chosen, blocks)]
    if not chosen or not blocks:
        return _Pairs(np.zeros((len(chosen), len(blocks))), *areas)
    shapes = [[_shape(item, kind) for item in items] for items in (chosen, blocks)]
    return _Pairs(np.asarray(coco_mask.iou(*shapes, [0] * len(blocks))), *areas)


def _shape(item: Mapping[str, Any], kind: Overlap) -> Any:
    return [float(value) for value in item["bbox"]] if kind == "bbox" else item["segmentation"]


def _score(group: str, confidence: float, threshold: float, images: Iterable[_Pairs]) -> Score:
    hits = predicted = true = 0
    ratios: list[NDArray[np.float64]] = []
    for pairs in images:
        matched = matches(pairs.overlap, threshold)
        chosen = np.flatnonzero(matched >= 0)
        hits, predicted, true = hits + len(chosen), predicted + pairs.overlap.shape[0], true + pairs.overlap.shape[1]
        true_area = pairs.true_area[matched[chosen]]
        ratios.append((pairs.predicted_area[chosen] / np.maximum(true_area, 1.0))[true_area > 0])  # a box may hold no mask
    every = np.concatenate(ratios) if ratios else np.zeros(0)
    ratio = float(every.mean()) if every.size else float("nan")
    return Score(group, confidence, threshold, hits, predicted - hits, true - hits, ratio)


def _stand_out(blocks: Sequence[Mapping[str, Any]]) -> float:
    known = [block["signal_to_noise"] for block in blocks if isinstance(block.get("signal_to_noise"), int | float)]
    return _share(sum(ratio > STANDS_OUT for ratio in known), len(known))


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
