"""Reliability of scores: of the detections with about the same score, the share that are blocks.

It is a reliability diagram (Murphy & Winkler 1977). Scores that are probabilities lie on its diagonal.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pipeline.detection.evaluation.evaluate import Overlap, matched_scores

EDGES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
"""Edges of the score classes, finer towards 1 where most detections lie; 1 itself belongs to the last."""
OVERLAP = 0.25
"""Overlap from which a detection counts as a block."""


@dataclass(frozen=True)
class ScoreClass:
    """Detections with scores between two limits, to compare their mean score with the share of them that are blocks.

    Attributes
    ----------
    low, high : Limits of the scores.
    score : Mean score.
    detections : Number of detections.
    right : Number of those that are blocks.
    """

    low: float
    high: float
    score: float
    detections: int
    right: int

    @property
    def precision(self) -> float:
        """Share of the detections in this class of scores that are blocks."""
        return self.right / self.detections

    @property
    def error(self) -> float:
        """Standard error of the precision in this class of scores.

        It is computed with one more block and one more false alarm, so that it is never 0 (Agresti & Coull 1998).
        """
        count = self.detections + 2
        share = (self.right + 1) / count
        return float(np.sqrt(share * (1 - share) / count))


@dataclass(frozen=True)
class Reliability:
    """Reliability of a detector's scores in one group of images: whether detections are blocks as often as their scores say.

    Attributes
    ----------
    group : Name of the group of images.
    classes : Score classes with at least one detection.
    kind : Overlap by which detections are matched with blocks: of masks ("segm") or boxes ("bbox").
    iou : Smallest overlap of a match (intersection over union).
    """

    group: str
    classes: tuple[ScoreClass, ...]
    kind: Overlap
    iou: float = OVERLAP

    @property
    def calibration_error(self) -> float:
        """Mean difference |precision - score| over the detections, 0 if scores are probabilities; NaN without detections.

        Precision and mean score are compared in classes of the score (Naeini et al. 2015).
        """
        count = sum(each.detections for each in self.classes)
        off = sum(abs(each.right - each.score * each.detections) for each in self.classes)
        return off / count if count else float("nan")

    def to_dict(self) -> dict[str, Any]:
        """Return the reliability of the scores in a group of images as JSON types, with null for NaN."""
        classes = [{**asdict(each), "precision": each.precision, "standard_error": each.error} for each in self.classes]
        error = None if np.isnan(self.calibration_error) else self.calibration_error
        return {"group": self.group, "kind": self.kind, "iou": self.iou, "calibration_error": error, "classes": classes}


def reliability(
    truth: Mapping[str, Any],
    predictions: Sequence[Mapping[str, Any]],
    groups: Mapping[str, Iterable[int]],
    kind: Overlap = "segm",
) -> list[Reliability]:
    """Compare the scores of detections with how many of them are blocks, for groups of images; return the result of each group.

    A detection is a block if their intersection over union is at least OVERLAP (0.25).

    Parameters
    ----------
    truth, predictions : COCO annotations and detections, as in `evaluate`.
    groups : Image ids by the name of their group.
    kind : Overlap of masks ("segm") or boxes ("bbox").
    """
    return [
        _group_reliability(group, *matched_scores(truth, predictions, images, OVERLAP, kind), kind)
        for group, images in groups.items()
    ]


def _group_reliability(group: str, score: np.ndarray, right: np.ndarray, kind: Overlap) -> Reliability:
    """Sort the (p,) scores of a group into classes."""
    number = np.minimum(np.searchsorted(EDGES, score, side="right"), len(EDGES) - 1) - 1
    count, hits, total = (np.bincount(number, each, len(EDGES) - 1) for each in (None, right, score))
    return Reliability(
        group,
        tuple(
            ScoreClass(EDGES[each], EDGES[each + 1], float(total[each] / count[each]), int(count[each]), int(hits[each]))
            for each in np.flatnonzero(count)
        ),
        kind,
    )
