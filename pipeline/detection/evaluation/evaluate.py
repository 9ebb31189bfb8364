"""Score detections against the truth: precision, recall, F1 and mask areas, and COCO's metrics.

Both use the matching of pycocotools. The thesis calls the precision AP and the recall AR.
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

from pipeline.change.annotate import DETECTABLE_SNR

CONFIDENCES, THRESHOLDS = (0.9, 0.95, 0.99), (0.25, 0.75)
"""Default lowest scores and lowest overlaps that count."""
Overlap = Literal["segm", "bbox"]
"""Overlap of masks or of boxes."""
_KEYS = ("image_id", "category_id", "segmentation", "bbox", "area", "iscrowd", "score")
"""Keys of COCO entries that pycocotools needs."""


@dataclass(frozen=True)
class Score:
    """Scores of a detector for one group of images at one confidence and one overlap.

    Attributes
    ----------
    group : Name of the group of images.
    confidence : Lowest score of the detections that count.
    iou : Lowest overlap (intersection over union) that counts as a match.
    true_positives, false_positives, false_negatives : Numbers of detections that match a block, detections that match none, and
        blocks that were not detected.
    area_ratio : Mean of predicted over true mask area of the matches; NaN without matches.
    kind : Overlap by which detections are matched with blocks: of masks ("segm") or boxes ("bbox").
    stand_out : Share of the blocks whose niche stands out from the noise for a matched filter, which is about the largest
        recall that any detector could reach (pipeline/change/matched_filter.py). NaN if the annotations do not say.
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
        """Share of the detector's detections that are blocks; NaN without detections."""
        return _share(self.true_positives, self.true_positives + self.false_positives)

    @property
    def recall(self) -> float:
        """Share of the annotated blocks that were detected; NaN without blocks."""
        return _share(self.true_positives, self.true_positives + self.false_negatives)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall of the detections; NaN where there is neither a block nor a detection."""
        return _share(2 * self.true_positives, 2 * self.true_positives + self.false_positives + self.false_negatives)

    def to_dict(self) -> dict[str, Any]:
        """Return the scores of a group of images as JSON types, with null for NaN."""
        values = {**asdict(self), "precision": self.precision, "recall": self.recall, "f1": self.f1}
        return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in values.items()}


def match_detections(overlap: NDArray[np.float64], threshold: float, crowd: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """Match the detections of one category in one image with the annotated blocks, as pycocotools does.

    Detections choose in the order of their scores. Each takes the free block that it overlaps most, if they overlap by the
    threshold. A detection without a block may fall on a crowd region, which any number of detections may share.

    Parameters
    ----------
    overlap : (p, t) array
        Overlap of p detections, best score first, with t annotations: intersection over union with a block, and intersection
        over the detection's area with a crowd region.
    threshold : float
        Smallest overlap of a match.
    crowd : (t,) bool array, optional
        Which annotations are crowd regions (COCO's `iscrowd`). None: no annotation is.

    Returns
    -------
    (p,) int array
        Index of the annotation that each detection is matched with, -1 for none. Of equal overlaps the last annotation counts.
    """
    detections, annotations = overlap.shape
    result = np.full(detections, -1)
    crowd = np.zeros(annotations, dtype=bool) if crowd is None else crowd
    least = min(threshold, 1 - 1e-10)  # as in pycocotools, so that rounding does not rule out a threshold of 1
    free = ~crowd
    for number, row in enumerate(overlap):
        for choice in (free, crowd):
            allowed = np.flatnonzero(choice & (row >= least))
            if allowed.size:
                best = allowed[::-1][np.argmax(row[allowed[::-1]])]
                result[number], free[best] = best, False
                break
    return result


def evaluate(
    truth: Mapping[str, Any],
    predictions: Sequence[Mapping[str, Any]],
    groups: Mapping[str, Iterable[int]] | None = None,
    confidences: Sequence[float] = CONFIDENCES,
    thresholds: Sequence[float] = THRESHOLDS,
    kind: Overlap = "segm",
) -> list[Score]:
    """Score COCO detections against COCO annotations, for every group, confidence and overlap.

    A detection matches annotations of its own category only. Crowd regions (`iscrowd`) are neither found nor missed, and a
    detection that falls on one is neither right nor wrong. Both are as in pycocotools, so that the scores agree with
    `coco_metrics`.

    Parameters
    ----------
    truth : mapping
        COCO's images and annotations, as `read_coco` gives them.
    predictions : sequence of mappings
        COCO's detections, as `read_detections` gives them.
    groups : mapping of names to image ids, optional
        Images that are scored together. None: all images as one group.
    confidences, thresholds : sequences of float
        Lowest scores and lowest overlaps that count.
    kind : {"segm", "bbox"}
        Overlap of masks or of boxes.

    Returns
    -------
    list of Score
        By group, then confidence, then threshold.
    """
    groups = groups or {"all": [image["id"] for image in truth["images"]]}
    blocks, found = _by_image_and_category(truth["annotations"]), _by_image_and_category(predictions)
    result = []
    for group, images in groups.items():
        keys = _keys(images, blocks, found)
        bound = _stand_out([block for key in keys for block in blocks.get(key, []) if not block.get("iscrowd")])
        for confidence in confidences:
            pairs = [_pairs(blocks.get(key, []), found.get(key, []), confidence, kind) for key in keys]
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
    """Return the scores of detections and whether each is matched with a block, to judge how reliable the scores are.

    Detections on crowd regions (`iscrowd`) are left out.

    Parameters
    ----------
    truth, predictions : COCO annotations and detections, as in `evaluate`.
    images : Ids of the images.
    threshold : Smallest overlap of a match (intersection over union).
    kind : Overlap of masks ("segm") or boxes ("bbox").

    Returns
    -------
    (p,) scores of the p detections, and (p,) bool: whether each is matched.
    """
    blocks, found = _by_image_and_category(truth["annotations"]), _by_image_and_category(predictions)
    scores: list[float] = []
    right: list[bool] = []
    for key in _keys(images, blocks, found):
        pairs = _pairs(blocks.get(key, []), found.get(key, []), 0.0, kind)
        matched = match_detections(pairs.overlap, threshold, pairs.crowd)
        counted = ~pairs.on_crowd(matched)
        scores += list(np.sort([item["score"] for item in found.get(key, [])])[::-1][counted])
        right += list(matched[counted] >= 0)
    return np.array(scores, dtype=np.float64), np.array(right, dtype=bool)


def coco_metrics(truth: Mapping[str, Any], predictions: Sequence[Mapping[str, Any]], kind: Overlap = "segm") -> dict[str, float]:
    """Compute pycocotools' twelve metrics of detections, by name: average precision and recall by overlap, area and count.

    truth, predictions: COCO annotations and detections, as in `evaluate`. kind: overlap of masks ("segm") or boxes ("bbox").
    Undefined metrics are -1.
    """
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
    with contextlib.redirect_stdout(io.StringIO()):
        reference = COCO()
        reference.dataset = {**truth, "annotations": _numbered(truth["annotations"])}
        reference.createIndex()
        found = reference.loadRes(_numbered(predictions)) if predictions else _without_annotations(reference)
        assessment = COCOeval(reference, found, kind)
        assessment.evaluate()
        assessment.accumulate()
        assessment.summarize()
    return {name: float(value) for name, value in zip(names, assessment.stats, strict=True)}


def _without_annotations(reference: COCO) -> COCO:
    """Return a data set without annotations, since pycocotools cannot load an empty list of detections."""
    empty = COCO()
    empty.dataset = {**reference.dataset, "annotations": []}
    empty.createIndex()
    return empty


def _numbered(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Number the entries from 1, as COCOeval takes id 0 for no match, and drop keys of other programs, such as captions."""
    return [{"id": number, **{key: entry[key] for key in _KEYS if key in entry}} for number, entry in enumerate(entries, start=1)]


@dataclass(frozen=True)
class _Pairs:
    """Detections and annotations of one category in one image.

    Attributes
    ----------
    overlap : (p, t) overlap of each detection with each annotation.
    predicted_area, true_area : (p,) and (t,) areas, px.
    crowd : (t,) COCO's `iscrowd`.
    """

    overlap: NDArray[np.float64]
    predicted_area: NDArray[np.float64]
    true_area: NDArray[np.float64]
    crowd: NDArray[np.bool_]

    def on_crowd(self, matched: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return the (p,) mask of detections that are matched with a crowd region."""
        return np.append(self.crowd, False)[matched]  # -1 (no match) indexes the appended False


Key = tuple[int, int]
"""Image id and category id."""


def _by_image_and_category(entries: Iterable[Mapping[str, Any]]) -> dict[Key, list[Mapping[str, Any]]]:
    """Group COCO entries by image and category."""
    result: dict[Key, list[Mapping[str, Any]]] = {}
    for entry in entries:
        result.setdefault((entry["image_id"], entry["category_id"]), []).append(entry)
    return result


def _keys(images: Iterable[int], *entries: Mapping[Key, Any]) -> list[Key]:
    """Return the sorted keys of these images that occur in any of the `entries`."""
    chosen = set(images)
    return sorted({key for each in entries for key in each if key[0] in chosen})


def _pairs(blocks: list[Mapping[str, Any]], found: list[Mapping[str, Any]], confidence: float, kind: Overlap) -> _Pairs:
    """Compute the overlaps of the detections with sufficient confidence and the annotated blocks."""
    chosen = sorted((item for item in found if item["score"] >= confidence), key=lambda item: -item["score"])
    predicted, true = (np.array([float(item["area"]) for item in items]) for items in (chosen, blocks))
    crowd = np.array([bool(block.get("iscrowd")) for block in blocks], dtype=bool)
    if not chosen or not blocks:
        return _Pairs(np.zeros((len(chosen), len(blocks))), predicted, true, crowd)
    shapes = [[_shape(item, kind) for item in items] for items in (chosen, blocks)]
    return _Pairs(np.asarray(coco_mask.iou(*shapes, crowd.astype(int).tolist())), predicted, true, crowd)


def _shape(item: Mapping[str, Any], kind: Overlap) -> Any:
    """Return what the overlap is computed of."""
    return [float(value) for value in item["bbox"]] if kind == "bbox" else item["segmentation"]


def _score(group: str, confidence: float, threshold: float, images: Iterable[_Pairs]) -> Score:
    """Match detections in all images and add up the counts."""
    hits = predicted = true = 0
    ratios: list[NDArray[np.float64]] = []
    for pairs in images:
        matched = match_detections(pairs.overlap, threshold, pairs.crowd)
        on_crowd = pairs.on_crowd(matched)
        chosen = np.flatnonzero((matched >= 0) & ~on_crowd)
        hits, predicted, true = hits + len(chosen), predicted + int((~on_crowd).sum()), true + int((~pairs.crowd).sum())
        true_area = pairs.true_area[matched[chosen]]
        ratios.append((pairs.predicted_area[chosen] / np.maximum(true_area, 1.0))[true_area > 0])  # a box may have an empty mask
    every = np.concatenate(ratios) if ratios else np.zeros(0)
    ratio = float(every.mean()) if every.size else float("nan")
    return Score(group, confidence, threshold, hits, predicted - hits, true - hits, ratio)


def _stand_out(blocks: Sequence[Mapping[str, Any]]) -> float:
    """Return the share of blocks that stand out from the noise."""
    known = [block["signal_to_noise"] for block in blocks if isinstance(block.get("signal_to_noise"), int | float)]
    return _share(sum(ratio > DETECTABLE_SNR for ratio in known), len(known))


def _share(part: int, whole: int) -> float:
    """Return a ratio; NaN if the denominator is 0."""
    return part / whole if whole else float("nan")
