"""The evaluation against a case counted by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from pipeline.change.annotate import run_length_encoding
from pipeline.detection.evaluation.evaluate import coco_metrics, evaluate, matches
from pipeline.detection.products.score_files import as_text, assess, write
from scene.common.errors import InputError


def _item(number: int, image: int, x: int, y: int, width: int, height: int, score: float | None = None) -> dict:
    entry = {
        "id": number, "image_id": image, "category_id": 1, "iscrowd": 0, "area": width * height, "bbox": [x, y, width, height],
        "segmentation": run_length_encoding(np.ones((height, width), bool), y, x, (64, 64)),
    }  # fmt: skip
    return entry if score is None else {**entry, "score": score}


@pytest.fixture
def truth():
    images = [
        {"id": n, "file_name": f"{n}.tif", "width": 64, "height": 64, "noise": noise} for n, noise in ((1, "low"), (2, "high"))
    ]
    blocks = [_item(1, 1, 0, 0, 10, 10), _item(2, 1, 20, 20, 10, 10), _item(3, 2, 5, 5, 20, 10)]
    return {"images": images, "annotations": blocks, "categories": [{"id": 1, "name": "block"}]}


@pytest.fixture
def found():
    return [
        _item(1, 1, 0, 0, 10, 10, 0.99),  # exact
        _item(2, 1, 0, 0, 10, 9, 0.97),  # a double of the same block
        _item(3, 1, 20, 20, 10, 5, 0.95),  # half of the second block: IoU 0.5, area ratio 0.5
        _item(4, 1, 50, 50, 5, 5, 0.92),  # nothing there
        _item(5, 2, 5, 5, 20, 10, 0.5),  # right, but not sure enough
    ]


def test_counts_by_hand(truth, found):
    by = {(s.confidence, s.iou): s for s in evaluate(truth, found)}
    loose, strict = by[0.9, 0.25], by[0.9, 0.75]
    assert (loose.true_positives, loose.false_positives, loose.false_negatives) == (2, 2, 1)
    assert (strict.true_positives, strict.false_positives, strict.false_negatives) == (1, 3, 2)
    assert loose.area_ratio == pytest.approx(0.75)
    assert (loose.precision, loose.recall, loose.f1) == pytest.approx((0.5, 2 / 3, 4 / 7))
    sure = by[0.99, 0.75]
    assert (sure.true_positives, sure.false_positives, sure.false_negatives) == (1, 0, 2)


def test_groups_keep_their_own_counts(truth, found):
    by = {s.group: s for s in evaluate(truth, found, {"low": [1], "high": [2]}, (0.4,), (0.75,))}
    assert (by["low"].true_positives, by["high"].true_positives, by["high"].false_positives) == (1, 1, 0)


def test_a_match_is_each_others_best_and_ties_go_to_the_first():
    assert_array_equal(matches(np.array([[0.8, 0.8], [0.8, 0.8]]), 0.5), [0, -1])
    assert_array_equal(matches(np.array([[0.6, 0.9], [0.2, 0.95]]), 0.5), [-1, 1])
    assert_array_equal(matches(np.array([[0.6, 0.1], [0.2, 0.7]]), 0.65), [-1, 1])
    assert_array_equal(matches(np.zeros((2, 0)), 0.5), [-1, -1])


def test_coco_metrics_of_perfect_and_of_no_detections(truth):
    perfect = [{**block, "score": 0.9} for block in truth["annotations"]]
    assert coco_metrics(truth, perfect)["AP"] == pytest.approx(1)
    assert coco_metrics(truth, [])["AP"] == 0


def test_files_by_name_and_tables(truth, found, tmp_path):
    (tmp_path / "annotations.json").write_text(json.dumps(truth))
    renamed = {
        "images": [{"id": 70 + image["id"], "file_name": image["file_name"]} for image in truth["images"]],
        "annotations": [{**item, "image_id": 70 + item["image_id"]} for item in found],
    }
    (tmp_path / "found.json").write_text(json.dumps(renamed))
    assessment = assess(tmp_path, tmp_path / "found.json", ["noise"])
    assert [score.group for score in assessment.scores[::6]] == 2 * ["all", "noise high", "noise low"]
    assert [score.kind for score in assessment.scores[::18]] == ["segm", "bbox"]
    assert assessment.scores[0].true_positives == 2
    assert "57.1 %" in as_text(assessment)
    write(assessment, tmp_path / "scores")
    assert len((tmp_path / "scores" / "scores.csv").read_text().splitlines()) == 1 + 2 * 18
    assert [each["group"] for each in json.loads((tmp_path / "scores" / "scores.json").read_text())["reliability"]] == [
        "all",
        "noise high",
        "noise low",
    ]
    assert (tmp_path / "scores" / "reliability.png").stat().st_size > 5000


def test_the_tables_say_how_many_blocks_stand_out_where_the_truth_knows(truth, found, tmp_path):
    assert np.isnan(evaluate(truth, found)[0].stand_out)
    for block, ratio in zip(truth["annotations"], (9.0, 4.0, None), strict=True):
        block["signal_to_noise"] = ratio
    assert evaluate(truth, found)[0].stand_out == 0.5
    (tmp_path / "annotations.json").write_text(json.dumps(truth))
    (tmp_path / "found.json").write_text(json.dumps(found))
    lines = as_text(assess(tmp_path, tmp_path / "found.json")).splitlines()
    assert lines.count("blocks that stand out from the noise (S/N > 4): 50.0 %") == 1
    assert [line for line in lines if line.startswith("all,")] == ["all, IoU of masks", "all, IoU of boxes"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"a": 1}', "no list of COCO detections"),
        ('[{"image_id": 1, "area": 3}]', "without a score"),
        ('[{"image_id": 9, "category_id": 1, "score": 0.3}]', "does not have"),
        ("nothing", "not JSON"),
    ],
)
def test_wrong_predictions_are_refused(truth, tmp_path, content, message):
    (tmp_path / "annotations.json").write_text(json.dumps(truth))
    (tmp_path / "found.json").write_text(content)
    with pytest.raises(InputError, match=message):
        assess(tmp_path, tmp_path / "found.json")


def test_an_unknown_key_names_the_known(truth, tmp_path):
    (tmp_path / "annotations.json").write_text(json.dumps(truth))
    (tmp_path / "found.json").write_text("[]")
    with pytest.raises(InputError, match="did you mean 'noise'"):
        assess(tmp_path, tmp_path / "found.json", ["niose"])


def test_the_tables_have_the_confidences_that_were_asked_for(truth, found, tmp_path):
    (tmp_path / "annotations.json").write_text(json.dumps(truth))
    (tmp_path / "found.json").write_text(json.dumps(found))
    assessment = assess(tmp_path, tmp_path / "found.json", confidences=(0.4, 0.995))
    assert [score.confidence for score in assessment.scores[:4]] == [0.4, 0.4, 0.995, 0.995]
    assert as_text(assessment).splitlines()[1].split() == ["confidence", "0.40", "0.40", "0.995", "0.995"]
