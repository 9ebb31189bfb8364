"""Calibrate the detector's scores so that a threshold of 0.95 gives the largest F1 on validation images.

A network trained on many faint blocks is unsure of most of them, and a threshold of 0.95 then finds few. Where most blocks are
missed, as small ones are, F1 is largest at a threshold with more false detections. Scores are therefore used as ranks rather than
as probabilities: a constant is added to all log odds, and another for each doubling of a block's side.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.change.annotate import BLOCK_CATEGORY
from pipeline.detection.evaluation.evaluate import evaluate
from pipeline.detection.inference import inference, weights
from pipeline.detection.network.data import CocoFolder

CONFIDENCE, OVERLAP = 0.95, 0.5
"""Score threshold to optimise for, and overlap of masks from which a block counts as detected."""
_HIGHEST = 1 - 1e-6
"""Largest score, so that its log odds are finite."""
_TRIED_PER_DOUBLING = (0.0, -0.25, 0.25, -0.5, 0.5, -0.75, 0.75, -1.0, 1.0)
"""Slopes to try, zero first, which is kept unless another one is better. The range is wide enough for the best one to
lie inside.
"""
_TRIED = tuple(float(score) for score in 1 / (1 + np.exp(-np.linspace(-3, 5, 33))))
"""Score thresholds to try."""


def set_operating_point(folder: Path, validation: CocoFolder) -> float:
    """Calibrate the scores of a trained detector, so that a threshold of 0.95 gives the largest F1, and save it.

    A shift is added to the log odds of the scores; it depends on the size of a detection. If the detector has mirrored views
    (`head.mirrored`), shifts are found with and without them.

    Parameters
    ----------
    folder : Folder of the detector.
    validation : Validation images.

    Returns
    -------
    The shift that the detector now adds for a box of 16 px; 0 if nothing is detected.
    """
    config = weights.load_config(folder)
    set_to: dict[str, float] = {}
    for mirrored in (False, True) if config.head.mirrored != "none" else (False,):
        model = weights.load(folder, mirrored=mirrored)
        set_to |= _best_head_shifts(model, validation, "mirrored_" if mirrored else "")
    model.config = weights.with_head(config, **set_to)
    weights.save(model, folder)  # without the optimizer's state
    return float(model.config.head.shifts[0])


def _best_head_shifts(model: Any, validation: CocoFolder, prefix: str) -> dict[str, float]:
    """Return the best shifts as keys of `head`, 0 if nothing is detected; prefix: of the keys."""
    before = model.config.head.shifts
    found = _detect_all(model, validation, min(_TRIED))
    blocks = [
        {**each, "category_id": BLOCK_CATEGORY["id"]} for each in validation.annotations
    ]  # sets may name the category otherwise
    best = best_shifts({"images": validation.images, "annotations": blocks}, found)
    shift, slope = (before[0] + best[0], before[1] + best[1]) if best else (0.0, 0.0)
    return {f"{prefix}score_shift": round(shift, 3), f"{prefix}score_per_doubling": slope}


def best_shifts(truth: dict[str, Any], found: list[dict[str, Any]]) -> tuple[float, float] | None:
    """Find how to shift the log odds of a detector's scores so that a score threshold of 0.95 gives the largest F1.

    The shift may depend on the size of a detection, which is that of its box.

    Parameters
    ----------
    truth : COCO images and annotations.
    found : COCO detections in these images.

    Returns
    -------
    Shift for a size of 16 px, and its change for each doubling of the size; None if nothing is detected.
    """
    best, result = 0.0, None
    for slope in _TRIED_PER_DOUBLING:
        shifted = [{**each, "score": _shifted(each, slope)} for each in found]
        for each in evaluate(truth, shifted, None, _TRIED, (OVERLAP,)):
            if each.f1 > best:  # False for NaN
                best, result = each.f1, (_log_odds(CONFIDENCE) - _log_odds(each.confidence), slope)
    return result


def _shifted(annotation: dict[str, Any], slope: float) -> float:
    """Return an annotation's score after shifting its log odds by a slope per doubling."""
    height, width = annotation["bbox"][2:]
    odds = _log_odds(min(annotation["score"], _HIGHEST)) + slope * 0.5 * math.log2(height * width / 16**2)
    return 1 / (1 + math.exp(-odds))


def _detect_all(model: Any, images: CocoFolder, lowest: float) -> list[dict[str, Any]]:
    """Detect blocks in all validation images."""
    found: list[dict[str, Any]] = []
    for index, image in enumerate(images.images):
        difference = images.labelled(index).difference
        for each in inference.detect(model, difference, lowest):
            found.append(each.annotation(len(found) + 1, image["id"], difference.shape))
    return found


def _log_odds(score: float) -> float:
    """Return ln(p / (1 - p))."""
    return math.log(score / (1 - score))
