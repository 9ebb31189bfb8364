"""The score from which on a detection counts, put where it finds blocks best on images that the training has not seen.

A network trained on many faint blocks is unsure of most, and a score of 0.95 then finds few. Scores are ranks more than they are
probabilities: all log odds are shifted by the same amount, such that 0.95 gives the largest F1 on the validation images.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.detection import inference, weights
from pipeline.detection.data import CocoFolder
from pipeline.detection.evaluate import evaluate

CONFIDENCE, OVERLAP = 0.95, 0.5
"""The score that is to be best, and the overlap of masks from which on a block counts as found."""
_TRIED = tuple(float(score) for score in 1 / (1 + np.exp(-np.linspace(-3, 5, 33))))


def set_operating_point(folder: Path, validation: CocoFolder) -> float:
    """Write the best shift of the scores into the detector in `folder`; returns it, 0 where no score finds a block."""
    model = weights.load(folder)
    before = model.config.head.score_shift
    found = _found(model, validation, min(_TRIED))
    truth = {"images": validation.images, "annotations": validation.annotations}
    values = [0.0 if math.isnan(each.f1) else each.f1 for each in evaluate(truth, found, None, _TRIED, (OVERLAP,))]
    shift = before + _log_odds(CONFIDENCE) - _log_odds(_TRIED[int(np.argmax(values))]) if max(values) > 0 else 0.0
    head = model.config.head.model_copy(update={"score_shift": round(shift, 3)})
    model.config = model.config.model_copy(update={"head": head})
    weights.save(model, folder)  # and without the optimizer's state, which a model in training saves too
    return shift


def _found(model: Any, images: CocoFolder, lowest: float) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for index, image in enumerate(images.images):
        difference = images.labelled(index).difference
        for each in inference.detect(model, difference, lowest):
            found.append(each.annotation(len(found) + 1, image["id"], difference.shape))
    return found


def _log_odds(score: float) -> float:
    return math.log(score / (1 - score))
