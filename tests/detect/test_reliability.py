"""Reliability diagrams: shares computed by hand, and shares of scores that are probabilities by construction."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipeline.change.annotate import run_length_encoding
from pipeline.detection.evaluation.reliability import EDGES, reliability
from pipeline.detection.products.figures import write_reliability

_COUNT = 4000


def _block(number: int, image: int, x: int, **more: float) -> dict:
    mask = run_length_encoding(np.ones((4, 4), bool), 0, x, (16, 16))
    return {"id": number, "image_id": image, "category_id": 1, "bbox": [x, 0, 4, 4], "area": 16, "segmentation": mask, **more}


def _set(scores: np.ndarray, there: np.ndarray) -> tuple[dict, list[dict]]:
    """Return images with one detection each, which lies on the image's block or beside it."""
    images = [{"id": number} for number in range(len(scores))]
    truth = {"images": images, "annotations": [_block(n, n, 0) for n in range(len(scores))]}
    return truth, [_block(n, n, 0 if there[n] else 8, score=float(scores[n])) for n in range(len(scores))]


def test_shares_by_hand():
    """Two of three detections between 0.9 and 0.95 are right, none of one below 0.1; scores of 0.99 and 1 are in the
    last class.
    """
    truth, found = _set(np.array([0.92, 0.9, 0.94, 0.05, 0.99, 1.0]), np.array([1, 1, 0, 0, 1, 1]))
    every, first = reliability(truth, found, {"all": range(6), "first": [0]})
    assert [(each.low, each.detections, each.right) for each in every.classes] == [(0.0, 1, 0), (0.9, 3, 2), (0.99, 2, 2)]
    assert every.classes[1].score == pytest.approx(0.92)
    assert every.calibration_error == pytest.approx((0.05 + abs(2 - 2.76) + 0.01) / 6)
    assert [(each.low, each.precision) for each in first.classes] == [(0.9, 1.0)]


def test_a_double_of_a_block_is_wrong():
    truth, found = _set(np.array([0.8]), np.array([1]))
    double = {**found[0], "id": 7, "score": 0.6}
    classes = reliability(truth, [*found, double], {"all": [0]})[0].classes
    assert [(each.low, each.right) for each in classes] == [(0.5, 0), (0.75, 1)]


def test_scores_that_are_probabilities_lie_on_the_diagonal():
    """Each of eight classes is within 3.5 standard errors (1 in 270 seeds fails); overconfident scores are not."""
    rng = np.random.default_rng(3)
    scores = rng.uniform(size=_COUNT)
    truth, found = _set(scores, rng.uniform(size=_COUNT) < scores)
    [one] = reliability(truth, found, {"all": range(_COUNT)})
    assert len(one.classes) == len(EDGES) - 1
    assert all(abs(each.precision - each.score) < 3.5 * each.error for each in one.classes)
    assert one.calibration_error < 0.03
    sure = [{**each, "score": 1 - (1 - each["score"]) ** 2} for each in found]
    assert reliability(truth, sure, {"all": range(_COUNT)})[0].calibration_error > 0.1


def test_no_detection_has_no_class_and_a_picture_all_the_same(tmp_path):
    truth, _ = _set(np.array([0.8]), np.array([1]))
    found = reliability(truth, [], {"all": [0]}, "bbox")
    assert found[0].to_dict() == {"group": "all", "kind": "bbox", "iou": 0.25, "calibration_error": None, "classes": []}
    write_reliability(found, tmp_path / "reliability.png")
    assert cv2.imread(str(tmp_path / "reliability.png")).std() > 5


def test_names_of_groups_are_cut_in_the_picture(tmp_path):
    """Drawing a name of a megabyte would take minutes."""
    truth, found = _set(np.array([0.8]), np.array([1]))
    groups = reliability(truth, found, {f"noise {number} {'x' * 1_000_000}": [0] for number in range(30)})
    write_reliability(groups, tmp_path / "reliability.png")
    assert cv2.imread(str(tmp_path / "reliability.png")).shape[:2] == (616, 704)
