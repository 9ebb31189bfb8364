"""COCO annotations against pycocotools' own encoder and reader."""

import json

import numpy as np
import pytest
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from scipy import ndimage

from pipeline.change.annotate import AnnotationConfig, LabelledImage, block_annotations, coco, run_length_encoding
from scene.geometry.grid import Grid

GRID = Grid(1.0, 9.0, 0.1, 90, 60)


def labels(seed):
    """Return a raster of ragged blobs in several pieces, touching borders and one another, with gaps in the numbering."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=GRID.shape), 2)
    blobs, _ = ndimage.label(noise > 0.05)
    return np.where(blobs % 3 == 1, 0, blobs // 2).astype(np.int32)


def dataset(count=3):
    config = AnnotationConfig(minimum_area_px=5)
    images = [
        LabelledImage(f"difference_{k:03d}.tif", labels(k), GRID, epoch=k, row=512, column=1024) for k in range(1, count + 1)
    ]
    return images, config, coco(images, config)


def full_mask_encoding(mask):
    encoded = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    return {"size": encoded["size"], "counts": encoded["counts"].decode("ascii")}


@pytest.mark.parametrize("window", [np.s_[3:8, 2:9], np.s_[0:12, 4:7], np.s_[0:12, 0:15], np.s_[5:12, 10:15], np.s_[0:1, 0:1]])
@pytest.mark.parametrize("density", [0.2, 0.9, 1.0])
def test_crop_encodes_to_the_bytes_of_the_full_mask(window, density):
    random = np.random.default_rng(11)
    for _ in range(20):
        crop = random.random((12, 15))[window] < density
        mask = np.zeros((12, 15), dtype=bool)
        mask[window] = crop
        encoding = run_length_encoding(crop, window[0].start, window[1].start, mask.shape)
        assert encoding == full_mask_encoding(mask)


def test_every_annotation_is_what_pycocotools_makes_of_its_mask():
    images, config, made = dataset(1)
    block = images[0].block
    expected = [label for label in np.unique(block[block > 0]) if np.sum(block == label) >= config.minimum_area_px]
    assert [annotation["block"] for annotation in made["annotations"]] == expected
    assert len(expected) > 10
    for annotation in made["annotations"]:
        encoding = full_mask_encoding(block == annotation["block"])
        assert annotation["segmentation"] == encoding
        assert annotation["bbox"] == coco_mask.toBbox(encoding).tolist()
        assert annotation["area"] == coco_mask.area(encoding)
        assert annotation["iscrowd"] == 0


def test_pycocotools_reads_the_label_raster_back(tmp_path):
    images, config, made = dataset()
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(made))
    reader = COCO(path)
    assert [reader.imgs[k]["file_name"] for k in (1, 2, 3)] == [image.file_name for image in images]
    assert reader.getCatIds(catNms=["block"]) == [1]
    for image_id, image in enumerate(images, start=1):
        again = np.zeros(GRID.shape, dtype=np.int32)
        for annotation in reader.imgToAnns[image_id]:
            again += annotation["block"] * reader.annToMask(annotation).astype(np.int32)
        areas = np.bincount(image.block.ravel())
        np.testing.assert_array_equal(again, np.where(areas[image.block] >= config.minimum_area_px, image.block, 0))


def test_ids_and_places():
    _, _, made = dataset()
    assert [image["id"] for image in made["images"]] == [1, 2, 3]
    assert [annotation["id"] for annotation in made["annotations"]] == list(range(1, len(made["annotations"]) + 1))
    assert {annotation["image_id"] for annotation in made["annotations"]} == {1, 2, 3}
    place = {"width": 90, "height": 60, "epoch": 2, "row": 512, "column": 1024, "x_min_m": 1.0, "y_max_m": 9.0, "gsd_m": 0.1}
    assert made["images"][1] == {"id": 2, "file_name": "difference_002.tif", **place}


def test_truth_given_as_detections_scores_one(tmp_path):
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(dataset()[2]))
    reader = COCO(path)
    found = [{key: item[key] for key in ("image_id", "category_id", "segmentation")} for item in reader.dataset["annotations"]]
    evaluation = COCOeval(reader, reader.loadRes([item | {"score": 1.0} for item in found]), "segm")
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    assert evaluation.stats[0] == pytest.approx(1.0)


def test_no_block_no_annotation():
    assert list(block_annotations(np.zeros((20, 30), dtype=np.int32), AnnotationConfig())) == []
    made = coco([], AnnotationConfig(), {"seed": 4})
    assert made["images"] == made["annotations"] == []
    assert made["info"]["seed"] == 4
