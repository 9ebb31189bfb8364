"""The evaluation against a case counted by hand."""

from __future__ import annotations

import contextlib
import copy
import io
import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from pipeline.change.annotate import run_length_encoding
from pipeline.detection.evaluation.evaluate import coco_metrics, evaluate, match_detections
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


def test_the_surest_detection_chooses_first_and_ties_go_to_the_last_as_in_pycocotools():
    assert_array_equal(match_detections(np.array([[0.8, 0.8], [0.8, 0.8]]), 0.5), [1, 0])
    assert_array_equal(match_detections(np.array([[0.6, 0.9], [0.2, 0.95]]), 0.5), [1, -1])
    assert_array_equal(match_detections(np.array([[0.6, 0.1], [0.2, 0.7]]), 0.65), [-1, 1])
    assert_array_equal(match_detections(np.zeros((2, 0)), 0.5), [-1, -1])


def test_a_crowd_region_takes_what_no_block_takes_any_number_of_times():
    overlap = np.array([[0.6, 1.0], [0.55, 0.9], [0.1, 0.5], [0.1, 0.4]])
    assert_array_equal(match_detections(overlap, 0.5, np.array([False, True])), [0, 1, 1, -1])


@pytest.mark.parametrize("kind", ["segm", "bbox"])
@pytest.mark.parametrize("seed", range(12))
def test_the_table_counts_as_pycocotools_on_drawn_sets(seed, kind):
    """Random sets with several images and categories, crowd regions, equal scores, duplicates, and images without anything."""
    truth, found = _drawn(np.random.default_rng(seed))
    for confidence in (0.0, 0.5, 0.9):
        kept = [item for item in found if item["score"] >= confidence]
        ours = evaluate(truth, found, None, (confidence,), (0.25, 0.5, 0.75), kind)
        counts = [(score.true_positives, score.false_positives, score.false_negatives) for score in ours]
        assert counts == _counts_of_pycocotools(truth, kept, (0.25, 0.5, 0.75), kind)


def _drawn(random):
    images = [{"id": n, "file_name": f"{n}.tif", "width": 64, "height": 64} for n in (3, 5, 9, 12)]
    categories = [{"id": n, "name": name} for n, name in ((1, "block"), (2, "vegetation"))]

    def place():
        return [int(value) for value in (*random.integers(0, 44, 2), *random.integers(4, 20, 2))]

    blocks, found = [], []
    for image in images[:3]:
        for _ in range(random.integers(0, 9)):
            x, y, width, height = place()
            block = {**_item(len(blocks) + 1, image["id"], x, y, width, height), "category_id": int(random.integers(1, 3))}
            blocks.append({**block, "iscrowd": int(random.random() < 0.25)})
            for _ in range(random.integers(0, 3)):
                shifted = [int(np.clip(value + random.integers(-3, 4), 0, 44)) for value in (x, y)]
                score = float(random.choice([0.3, 0.5, 0.5, 0.8, 0.95]))
                item = _item(len(found) + 1, image["id"], *shifted, width, height, score)
                found.append(
                    {**item, "category_id": int(random.integers(1, 3)) if random.random() < 0.2 else block["category_id"]}
                )
    found.append(_item(len(found) + 1, 12, *place(), 0.7))
    return {"images": images, "annotations": blocks, "categories": categories}, found


def _counts_of_pycocotools(truth, found, thresholds, kind):
    """Return true positives, false positives and false negatives, from pycocotools' own matches of each image and category."""
    with contextlib.redirect_stdout(io.StringIO()):
        reference = COCO()
        reference.dataset = copy.deepcopy(truth)
        reference.createIndex()
        results = COCO()
        results.dataset = {**copy.deepcopy(truth), "annotations": copy.deepcopy(found)}
        results.createIndex()
        judge = COCOeval(reference, results, kind)
        judge.params.iouThrs, judge.params.maxDets = np.array(thresholds), [1000]
        judge.params.areaRng, judge.params.areaRngLbl = [[0, 1e10]], ["all"]
        judge.evaluate()
    counts = np.zeros((len(thresholds), 3), dtype=int)
    for each in filter(None, judge.evalImgs):
        real, counted = ~np.array(each["gtIgnore"], dtype=bool), ~np.array(each["dtIgnore"], dtype=bool)
        right = (np.array(each["dtMatches"]) > 0) & counted
        counts[:, 0] += right.sum(axis=1)
        counts[:, 1] += (counted & ~right).sum(axis=1)
        counts[:, 2] += real.sum() - right.sum(axis=1)
    return [tuple(int(value) for value in row) for row in counts]


def test_each_category_has_a_table_of_its_own_beside_the_total(truth, found, tmp_path):
    """All detections have the category vegetation where the truth has rockfall: none is right in any table or in
    COCO's summary.
    """
    truth["categories"].append({"id": 2, "name": "vegetation"})
    truth["annotations"].append({**_item(9, 2, 40, 40, 8, 8), "category_id": 2})
    (tmp_path / "annotations.json").write_text(json.dumps(truth))
    (tmp_path / "found.json").write_text(json.dumps([{**item, "category_id": 2} for item in found]))
    assessment = assess(tmp_path, tmp_path / "found.json", kinds=("segm",), confidences=(0.9,))
    counts = {(s.group, s.iou): (s.true_positives, s.false_positives, s.false_negatives) for s in assessment.scores}
    assert counts["all", 0.25] == (0, 4, 4)
    assert counts["category block", 0.25] == (0, 0, 3)
    assert counts["category vegetation", 0.25] == (0, 4, 1)
    assert assessment.coco["AP"] == 0


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
        ('{"a": 1}', "not a list of COCO detections"),
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
