"""The score from which on a detection counts, put where it finds blocks best on images that the training has not seen.

A network trained on many faint blocks is unsure of most, and a score of 0.95 then finds few; and where most blocks are missed, as
small ones are, F1 is largest at a score at which more of the detections are wrong. Scores are ranks more than they are
probabilities: all log odds are shifted by the same amount, and by another for each doubling of a block's side, such that 0.95
gives the largest F1 on the validation images.
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
"""The score that is to be best, and the overlap of masks from which on a block counts as found."""
_HIGHEST = 1 - 1e-6
"""Of a score, whose log odds are finite then."""
_TRIED_PER_DOUBLING = (0.0, -0.25, 0.25, -0.5, 0.5, -0.75, 0.75, -1.0, 1.0)
"""Nothing first, which stays where others are no better. The slope that was found best is inside, not at an end."""
_TRIED = tuple(float(score) for score in 1 / (1 + np.exp(-np.linspace(-3, 5, 33))))


def set_operating_point(folder: Path, validation: CocoFolder) -> float:
    """Write the best shifts of the scores into the detector in `folder`, 0 where nothing is found; returns that of 16 px.

    They are set for maps as they are, and for their mirror images too where the detector looks at those (`head.mirrored`);
    what is returned is of the way that it looks.
    """
    config = weights.load_config(folder)
    set_to: dict[str, float] = {}
    for unmirrored in (True, False) if config.head.mirrored != "none" else (True,):
        model = weights.load(folder, unmirrored=unmirrored)
        set_to |= _set_on(model, validation, "" if unmirrored else "mirrored_")
    model.config = weights.with_head(config, **set_to)
    weights.save(model, folder)  # and without the optimizer's state, which a model in training saves too
    return float(model.config.head.shifts[0])


def _set_on(model: Any, validation: CocoFolder, prefix: str) -> dict[str, float]:
    """The shifts of `head` with which CONFIDENCE is best for the model, 0 where nothing is found. prefix: of their keys."""
    before = model.config.head.shifts
    found = _found(model, validation, min(_TRIED))
    blocks = [{**each, "category_id": BLOCK_CATEGORY["id"]} for each in validation.annotations]  # whatever a set calls them
    best = best_shifts({"images": validation.images, "annotations": blocks}, found)
    shift, slope = (before[0] + best[0], before[1] + best[1]) if best else (0.0, 0.0)
    return {f"{prefix}score_shift": round(shift, 3), f"{prefix}score_per_doubling": slope}


def best_shifts(truth: dict[str, Any], found: list[dict[str, Any]]) -> tuple[float, float] | None:
    """What to add to the log odds of detections (COCO) of 16 px, and for each doubling of the side, so that CONFIDENCE is best.

    A detection's side is that of its mask's bounds. None where nothing is found.
    """
    best, result = 0.0, None
    for slope in _TRIED_PER_DOUBLING:
        shifted = [{**each, "score": _shifted(each, slope)} for each in found]
        for each in evaluate(truth, shifted, None, _TRIED, (OVERLAP,)):
            if each.f1 > best:  # False for NaN
                best, result = each.f1, (_log_odds(CONFIDENCE) - _log_odds(each.confidence), slope)
    return result


def _shifted(annotation: dict[str, Any], slope: float) -> float:
    height, width = annotation["bbox"][2:]
    odds = _log_odds(min(annotation["score"], _HIGHEST)) + slope * 0.5 * math.log2(height * width / 16**2)
    return 1 / (1 + math.exp(-odds))


def _found(model: Any, images: CocoFolder, lowest: float) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for index, image in enumerate(images.images):
        difference = images.labelled(index).difference
        for each in inference.detect(model, difference, lowest):
            found.append(each.annotation(len(found) + 1, image["id"], difference.shape))
    return found


def _log_odds(score: float) -> float:
    return math.log(score / (1 - score))
