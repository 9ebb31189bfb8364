"""COCO files, good and bad, as `evaluate`, `train` and `detect` read them."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from test_fuzz import ODD, QUICK, answered, places

from pipeline.change.annotate import run_length_encoding
from pipeline.cli.main import main
from pipeline.dataset.loaders import Tiles
from pipeline.detection.network.data import CocoFolder
from pipeline.detection.products.score_files import assess
from pipeline.formats.rasters.geotiff import write_tiff
from pipeline.formats.records.coco import read_coco, read_detections
from pipeline.formats.records.coco_masks import run_lengths

H, W = 48, 64
SQUARES = [(1, 4, 6, 10, 12), (1, 30, 20, 15, 9), (2, 10, 8, 20, 20)]
"""Image, x, y, width, height of the blocks, px."""
Content = dict[str, Any]


def _rle(x: int, y: int, width: int, height: int) -> dict:
    return run_length_encoding(np.ones((height, width), bool), y, x, (H, W))


def _polygon(x: int, y: int, width: int, height: int) -> list[list[int]]:
    return [[x, y, x + width, y, x + width, y + height, x, y + height]]


def truth(shape: Callable[..., Any] = _rle) -> Content:
    images = [{"id": n, "file_name": f"{n}.tif", "width": W, "height": H, "noise": f"{n} cm", "list": [n]} for n in (1, 2)]
    blocks = [
        {"id": n, "image_id": image, "category_id": 1, "iscrowd": 0, "area": 1, "bbox": box, "segmentation": shape(*box)}
        for n, (image, *box) in enumerate(SQUARES, start=1)
    ]
    return {"images": images, "annotations": blocks, "categories": [{"id": 1, "name": "block"}]}


def found() -> Content:
    content = truth()
    content["annotations"] = [{**each, "score": 0.95} for each in content["annotations"]]
    return content


def written(folder: Path, true: Any, detected: Any) -> tuple[Path, Path]:
    paths = folder / "annotations.json", folder / "found.json"
    for path, content in zip(paths, (true, detected), strict=True):
        path.write_text(json.dumps(content))
    for number in (1, 2):
        write_tiff(folder / f"{number}.tif", np.zeros((H, W), np.float32))
    return paths


def test_polygons_count_as_the_pixels_that_they_enclose(tmp_path):
    paths = written(tmp_path, truth(_polygon), found())
    assessment = assess(*paths)
    assert [(s.true_positives, s.false_positives, s.false_negatives) for s in assessment.scores[:4]] == [(3, 0, 0)] * 4
    assert assessment.scores[0].area_ratio == 1
    assert assessment.coco["AP"] == pytest.approx(1)


def test_polygons_are_learned_as_pycocotools_draws_them(tmp_path):
    """A slanted outline, one with two parts, and one smaller than a pixel, whose mask is empty."""
    content = truth(_polygon)
    content["annotations"][0]["segmentation"] = [[4.5, 6, 13, 9.5, 8, 17.25]]
    content["annotations"][1]["segmentation"] = [[30, 20, 40, 20, 35, 28.5], [40, 22, 45, 22, 45, 29, 40, 29]]
    content["annotations"][2]["segmentation"] = [[10, 8, 10.2, 8, 10.2, 8.2]]
    written(tmp_path, content, found())
    reader, folder = COCO(tmp_path / "annotations.json"), CocoFolder(tmp_path)
    labelled = folder.labelled(0)
    for number in (1, 2):
        assert_array_equal(labelled.labels == number, reader.annToMask(reader.anns[number]) > 0)
    assert len(labelled.boxes) == 2
    assert len(folder.labelled(1).boxes) == 0
    masks = Tiles(tmp_path, noise="1 cm")[0].masks
    assert_array_equal(masks, [reader.annToMask(reader.anns[number]) > 0 for number in (1, 2)])


def test_boxes_alone_do_for_scores_of_boxes(tmp_path, capsys):
    contents = truth(), found()
    for content in contents:
        content["annotations"] = [{k: v for k, v in each.items() if k != "segmentation"} for each in content["annotations"]]
    paths = [str(path) for path in written(tmp_path, *contents)]
    assert main(["evaluate", *paths, "--iou", "bbox"]) == 0
    assert main(["evaluate", *paths]) == 2
    assert "annotation 1: the annotation has no mask" in capsys.readouterr().err


def test_a_plain_list_of_results_and_missing_boxes_are_filled_in(tmp_path):
    keys = ("image_id", "category_id", "segmentation", "score")
    plain = [{key: each[key] for key in keys} for each in found()["annotations"]]
    paths = written(tmp_path, truth(), plain)
    read = read_detections(paths[1], read_coco(paths[0]))
    assert [each["bbox"] for each in read] == [list(box) for _, *box in SQUARES]
    assert [each["area"] for each in read] == [width * height for _, _, _, width, height in SQUARES]
    assert assess(*paths).coco["AP"] == pytest.approx(1)


def test_an_id_of_zero_and_keys_of_others_do_not_change_the_scores(tmp_path):
    contents = truth(), found()
    for content in contents:
        for each in content["annotations"]:
            each.update(id=each["id"] - 1, caption="a", keypoints=[])
    assert assess(*written(tmp_path, *contents)).coco["AP"] == pytest.approx(1)


def test_run_lengths_are_read_as_pycocotools_reads_them():
    random = np.random.default_rng(4)
    for _ in range(50):
        height, width = random.integers(1, 60, 2)
        mask = random.random((height, width)) < random.choice([0, 0.02, 0.5, 0.98, 1])
        packed = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
        text = packed["counts"].decode()
        size = [int(height), int(width)]
        changes = np.flatnonzero(np.diff(mask.T.ravel().astype(int), prepend=0))
        lengths = np.diff(changes, prepend=0, append=mask.size).tolist()
        for counts in (text, lengths):
            read = run_lengths({"size": size, "counts": counts}, *size, "")
            assert_array_equal(coco_mask.decode(read), mask)
        assert run_lengths({"size": size, "counts": text}, *size, "")["counts"] == text


def _change(kind: str, key: str, value: Any, number: int = 0) -> Callable[[Content], Any]:
    def change(content: Content) -> None:
        if value is ...:
            del content[kind][number][key]
        else:
            content[kind][number][key] = value

    return change


def _mask(value: Any) -> Callable[[Content], Any]:
    return _change("annotations", "segmentation", value)


def _run_lengths(**values: Any) -> Callable[[Content], Any]:
    return _mask({**_rle(4, 6, 10, 12), **values})


OF_BOTH = {
    "no mapping": (lambda content: content.update(annotations=[1]), "is of the type int"),
    "no annotations": (lambda content: content.pop("annotations"), "COCO"),
    "annotations no list": (lambda content: content.update(annotations={}), "COCO"),
    "images no list": (lambda content: content.update(images=3), "'images' is not a list"),
    "images without id": (_change("images", "id", ...), "image 0 of the list: 'id' is missing"),
    "an image's id is a list": (_change("images", "id", [1]), "image 0 of the list: 'id'"),
    "images without file name": (_change("images", "file_name", ...), "image 1: 'file_name' is missing"),
    "an image twice": (_change("images", "id", 2), "image 2: the id of the entry occurs twice"),
    "a file twice": (_change("images", "file_name", "2.tif"), "the file_name '2.tif' occurs twice"),
    "an annotation twice": (_change("annotations", "id", 2), "2: the id of the entry occurs twice"),
    "an id of half": (_change("annotations", "id", 1.5), "'id': input should be a valid integer, got 1.5"),
    "another image": (_change("annotations", "image_id", 77), "77"),
    "no image id": (_change("annotations", "image_id", ...), "1: 'image_id' is missing"),
    "no category": (_change("annotations", "category_id", ...), "1: 'category_id' is missing"),
    "another category": (_change("annotations", "category_id", 9), "1: the annotation's category 9 is not listed; allowed: 1"),
    "crowd": (_change("annotations", "iscrowd", "no"), "'iscrowd'"),
    "box of three": (_change("annotations", "bbox", [1, 2, 3]), "1: 'bbox'"),
    "box of text": (_change("annotations", "bbox", [1, 2, 3, "4"]), "1: 'bbox.3'"),
    "box with NaN": (_change("annotations", "bbox", [1, 2, 3, float("nan")]), "finite number, got nan"),
    "box outside": (_change("annotations", "bbox", [60, 2, 30, 4]), "the annotation's bbox is [60, 2, 30, 4]; allowed: x, y"),
    "box turned over": (_change("annotations", "bbox", [20, 20, -3, 4]), "the annotation's bbox is [20, 20, -3, 4]"),
    "area": (_change("annotations", "area", float("inf")), "'area'"),
    "no mask": (_mask(...), "1: the annotation has no mask; allowed: polygons"),
    "null": (_mask(None), "1: the annotation has no mask"),
    "text": (_mask("abc"), "the annotation's segmentation is 'abc'"),
    "a number": (_mask(7), "the annotation's segmentation is 7"),
    "no polygon": (_mask([]), "has no polygon"),
    "polygon of an odd count": (_mask([[1, 1, 9, 1, 9, 9, 1]]), "polygon 1 of the annotation's segmentation is invalid; allowed"),
    "polygon of two points": (_mask([[1, 1, 9, 1]]), "at least 3 points"),
    "the second polygon": (_mask([[1, 1, 9, 1, 9, 9], [1, 2]]), "polygon 2"),
    "polygon with NaN": (_mask([[1, 1, 9, 1, 9, float("nan")]]), "finite numbers"),
    "polygon of text": (_mask([["a", 1, 9, 1, 9, 9]]), "finite numbers"),
    "polygon not nested": (_mask([1, 1, 9, 1, 9, 9]), "polygon 1"),
    "polygon far outside": (_mask([[1, 1, 1e9, 1, 9, 9]]), "goes beyond the image; allowed: x from 0 to 64, y from 0 to 48"),
    "size of 1e6": (_run_lengths(size=[10**6, 10**6], counts=[10**12]), "[1000000, 1000000]; allowed: [48, 64]"),
    "size turned": (_run_lengths(size=[W, H]), "[64, 48]; allowed: [48, 64]"),
    "size of text": (_run_lengths(size="48 64"), "'48 64'; allowed: [48, 64]"),
    "size missing": (_mask({"counts": [H * W]}), "is missing; allowed: [48, 64]"),
    "counts missing": (_mask({"size": [H, W]}), "cannot be decoded"),
    "counts garbage": (_run_lengths(counts="@@garbage!!"), "cannot be decoded"),
    "counts of other characters": (_run_lengths(counts="é\n"), "cannot be decoded"),
    "counts endless": (_run_lengths(counts="oooooooooooo0"), "cannot be decoded"),
    "counts cut": (_run_lengths(counts=_rle(4, 6, 10, 12)["counts"][:-3]), "cannot be decoded"),
    "counts too few": (_run_lengths(counts=[5, 5]), "of 3072 pixels in all"),
    "counts negative": (_run_lengths(counts=[-5, H * W + 5]), "cannot be decoded"),
    "counts no whole numbers": (_run_lengths(counts=[1.5, H * W - 1.5]), "cannot be decoded"),
}  # fmt: skip
OF_TRUTH = {
    "no categories": (lambda content: content.pop("categories"), "'categories' is missing"),
    "no size": (_change("images", "width", ...), "image 1: 'width' is missing"),
    "a size of nothing": (_change("images", "height", 0), "image 1: 'height'"),
    "an image too large": (
        _change("images", "width", 10**7),
        "image 1: the image has 48 x 10000000 px; allowed: at most 250,000,000 px",
    ),
    "no image": (lambda content: content.update(images=[]), "the list 'images' is empty"),
}
OF_DETECTIONS = {
    "no score": (_change("annotations", "score", ..., 1), "without a score"),
    "score of text": (_change("annotations", "score", "0.9"), "detection 1: 'score'"),
    "score NaN": (_change("annotations", "score", float("nan")), "detection 1: 'score'"),
    "score above one": (_change("annotations", "score", 1.5), "a score from 0 to 1"),
    "ids of two kinds": (_change("annotations", "image_id", "x"), "detection 1: 'image_id'"),
    "a file of another set": (_change("images", "file_name", "other.tif"), "that the truth does not have, such as id 1"),
    "no images": (lambda content: content.pop("images"), "'images' is missing"),
}


def _refused(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the message of a command that must fail with exit code 2, print one line and leave no files."""
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert len(message) < 1000
    assert not (tmp_path / "out").exists()
    return message.replace("in this entry, keys or values are wrong: ", "")  # the cases give place and key, side by side


@pytest.mark.parametrize("case", OF_BOTH | OF_TRUTH)
def test_a_mistake_in_the_truth_is_named(case, tmp_path, capsys):
    change, told = (OF_BOTH | OF_TRUTH)[case]
    content = truth()
    change(content)
    paths = [str(path) for path in written(tmp_path, content, found())]
    message = _refused(["evaluate", *paths], tmp_path, capsys)
    assert told in message
    assert "annotations.json" in message
    for split in ("train", "val"):
        (tmp_path / split).mkdir()
        written(tmp_path / split, content, [])
    assert told in _refused(["train", str(tmp_path)], tmp_path, capsys)


@pytest.mark.parametrize("case", OF_BOTH | OF_DETECTIONS)
def test_a_mistake_in_the_detections_is_named(case, tmp_path, capsys):
    change, told = (OF_BOTH | OF_DETECTIONS)[case]
    content = found()
    change(content)
    message = _refused(["evaluate", *map(str, written(tmp_path, truth(), content))], tmp_path, capsys)
    assert told in message
    assert "found.json" in message


@pytest.mark.parametrize("case", ["an image's id is a list", "no image id", "polygon of two points", "no annotations"])
def test_detect_names_the_same_mistakes(case, tmp_path, capsys):
    change, told = OF_BOTH[case]
    content = truth()
    change(content)
    written(tmp_path, content, [])
    assert told in _refused(["detect", "baseline", str(tmp_path)], tmp_path, capsys)


def test_a_key_whose_values_are_no_words_makes_no_groups(tmp_path, capsys):
    paths = [str(path) for path in written(tmp_path, truth(), found())]
    message = _refused(["evaluate", *paths, "--by", "list"], tmp_path, capsys)
    assert "the images' 'list' is not a word or number; allowed: file_name, height, id, noise, width" in message


@QUICK
@given(data=st.data())
def test_odd_values_anywhere_are_read_or_refused(tmp_path, data):
    contents = [truth(data.draw(st.sampled_from([_rle, _polygon]))), found()]
    content = copy.deepcopy(contents[data.draw(st.sampled_from([0, 1]))])
    path = data.draw(st.sampled_from(list(places(content))))
    holder = content
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = data.draw(ODD)
    contents["score" in str(content)] = content
    paths = written(tmp_path, *contents)
    answered(lambda: assess(*paths, keys=["noise"]))
