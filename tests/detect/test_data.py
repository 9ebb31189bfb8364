"""Test the detector's input and output without a network.

This covers normalisation, COCO folders, tiles, merging across tile borders, masks, events and the baseline.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from test_model import make_set

from pipeline.cli.main import main
from pipeline.detection.evaluation.detections import Detection, detection_from_mask, without_duplicates
from pipeline.detection.inference import baseline, inference
from pipeline.detection.inference.inference import paste, tile_places
from pipeline.detection.network.config import DetectorConfig, NormalisationConfig, TrainingConfig
from pipeline.detection.network.data import CocoFolder, batches, mirrored, network_input
from pipeline.detection.network.keras_backend import import_keras
from pipeline.detection.network.normalisation import denormalised, nmad, normalised
from pipeline.detection.products import events
from pipeline.detection.products.run import detect, find_inputs
from pipeline.detection.training.schedule import has_converged, learning_rate
from pipeline.formats.rasters.geotiff import write_geotiff
from scene.common.errors import InputError
from scene.common.native_output import suppress_stderr
from scene.geometry.grid import Grid


def _map() -> np.ndarray:
    difference = np.random.default_rng(1).normal(0.0, 0.02, (40, 50)).astype(np.float32)
    difference[3:9, 4:20] = np.nan
    return difference


def test_minmax_spans_zero_to_one_and_goes_back():
    difference = _map()
    image = normalised(difference, NormalisationConfig(method="minmax"))
    valid = np.isfinite(difference)
    assert (image[..., 0][valid].min(), image[..., 0][valid].max()) == (0, 1)
    assert_array_equal(image[..., 1], valid)
    low, high = difference[valid].min(), difference[valid].max()
    assert_allclose(denormalised(image[..., 0], low, high)[valid], difference[valid], atol=5e-8)


def test_fixed_keeps_the_amplitude_and_level_of_detection_the_ratio_to_the_noise():
    difference = _map()
    valid = np.isfinite(difference)
    fixed = NormalisationConfig(method="fixed", scale_m=0.05)
    assert_allclose(np.sinh(normalised(difference, fixed)[..., 0][valid]) * 0.05, difference[valid], rtol=1e-5, atol=1e-7)
    relative = NormalisationConfig(method="level_of_detection", validity_channel=False)
    assert_allclose(normalised(difference, relative), normalised(3 * difference, relative), rtol=1e-5, atol=1e-6)
    assert nmad(difference) == pytest.approx(0.02, rel=0.05)  # 1800 values: 3 % is two of its standard errors
    assert np.isfinite(normalised(np.full((4, 4), np.nan, np.float32), relative)).all()


def test_batches_depend_on_seed_and_epoch_alone(tmp_path):
    folder = CocoFolder(make_set(tmp_path, 5, 3, side=64, blocks=1))
    config, training = DetectorConfig(image_px=64, most_blocks=4), TrainingConfig(batch=2)
    first, again, other = (list(batches(folder, config, training, epoch, learning=True)) for epoch in (0, 0, 1))
    assert len(first) == 3
    for one, two in zip(first, again, strict=True):
        assert all(np.array_equal(one[name], two[name]) for name in one)
    assert any(not np.array_equal(one["image"], two["image"]) for one, two in zip(first, other, strict=True))
    plain = next(batches(folder, config, training, 0, learning=False))
    assert_array_equal(plain["labels"][0], folder.labelled(0).labels)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_map_has_its_blocks_mirrored(tmp_path, axis):
    labelled = CocoFolder(make_set(tmp_path, 1, 4, blocks=2)).labelled(0)
    turned = mirrored(labelled, axis)
    for number, (y0, x0, y1, x1) in enumerate(turned.boxes, start=1):
        rows, columns = np.nonzero(turned.labels == number)
        assert (rows.min(), columns.min(), rows.max() + 1, columns.max() + 1) == (y0, x0, y1, x1)
    assert_array_equal(mirrored(turned, axis).labels, labelled.labels)
    assert_array_equal(mirrored(turned, axis).boxes, labelled.boxes)


@pytest.mark.parametrize(("flips", "turned"), [(True, True), ("left_right", False), (False, False)])
def test_maps_are_mirrored_along_the_axes_asked_for(tmp_path, flips, turned):
    """The topmost rows have no data; left and right differ by the places of the blocks."""
    folder = CocoFolder(make_set(tmp_path, 8, 3, side=64, blocks=1))
    config, training = DetectorConfig(image_px=64, most_blocks=4), TrainingConfig(batch=1, flips=flips)
    examples = list(batches(folder, config, training, 0, learning=True))
    assert any(example["image"][0, 0, 0, 1] == 1 for example in examples) is turned
    plain = [folder.labelled(index).labels for index in range(8)]
    as_it_is = [any(np.array_equal(example["labels"][0], labels) for labels in plain) for example in examples]
    assert all(as_it_is) is (flips is False)


def test_blocks_to_ignore_are_marked_as_such_for_the_loss(tmp_path):
    """COCO's `ignore` and `iscrowd` give the class -1, where a block has 1 and padding 0."""
    folder = make_set(tmp_path, 1, 4, blocks=3)
    path = folder / "annotations.json"
    content = json.loads(path.read_text())
    content["annotations"][0]["ignore"] = 1
    content["annotations"][1]["iscrowd"] = 1
    path.write_text(json.dumps(content))
    labelled = CocoFolder(folder).labelled(0)
    assert labelled.ignored.tolist() == [True, True, False]
    side = labelled.difference.shape[0]
    assert network_input(labelled, DetectorConfig(image_px=side, most_blocks=4))["valid"].tolist() == [-1, -1, 1, 0]


@pytest.mark.parametrize(("shape", "count"), [((512, 512), 1), ((300, 200), 1), ((513, 512), 2), ((1024, 700), 3 * 2)])
def test_tiles_cover_the_map_and_share_a_quarter_of_their_side(shape, count):
    places = list(tile_places(shape, 512))
    assert len(places) == count
    for starts in (np.unique([place[axis] for place in places]) for axis in (0, 1)):
        assert (np.diff(starts) <= 384).all()
    seen = np.zeros(shape, bool)
    for row, column in places:
        seen[row : row + 512, column : column + 512] = True
    assert seen.all()


def test_a_mask_is_pasted_at_its_place():
    """A half-plane mask has its edge at a known place; the box has sub-pixel corners."""
    probability = np.zeros((56, 56), np.float32)
    probability[:, :28] = 1
    row, column, mask = paste(probability, np.array([10.25, 20.5, 30.25, 40.5], np.float32), 64)
    assert (row, column, mask.shape) == (10, 20, (21, 21))
    assert mask[:, :10].all()  # pixel centres up to 29.5 lie left of the middle, 30.5
    assert not mask[:, 11:].any()


def test_run_lengths_go_round():
    mask = np.random.default_rng(3).random((9, 7)) > 0.4
    item = detection_from_mask(mask, 5, 6, 0.7)
    assert item is not None
    entry = item.annotation(1, 1, (32, 40))
    whole = np.zeros((32, 40), bool)
    whole[5:14, 6:13] = mask
    assert_array_equal(coco_mask.decode(entry["segmentation"]).astype(bool), whole)
    assert entry["area"] == mask.sum() == coco_mask.area(entry["segmentation"])
    assert entry["bbox"] == list(coco_mask.toBbox(entry["segmentation"]))


def test_the_better_of_two_detections_of_one_block_stays():
    whole, part = np.ones((20, 20), bool), np.ones((20, 12), bool)
    found = without_duplicates([Detection(0, 0, part, 0.8), Detection(0, 0, whole, 0.9), Detection(0, 19, whole, 0.7)])
    assert [item.score for item in found] == [0.9, 0.7]


def test_the_volume_of_a_known_niche():
    difference = np.zeros((50, 60), np.float32)
    difference[10:20, 30:50] = 0.25
    difference[10, 30] = np.nan
    item = detection_from_mask(difference[10:20, 30:50] != 0, 10, 30, 0.99)
    assert item is not None
    found = events.event(item, 1, "map", difference, Grid(100.0, 7.0, 0.02, 60, 50))
    assert (found.x_m, found.y_m) == pytest.approx((100.0 + 40 * 0.02, 7.0 - 15 * 0.02))
    assert found.area_m2 == pytest.approx(200 * 0.02**2)
    assert (found.depth_m, found.volume_m3) == pytest.approx((0.25, 0.25 * 200 * 0.02**2))


def test_the_baseline_finds_niches_above_the_level_of_detection_and_no_noise(tmp_path):
    folder = CocoFolder(make_set(tmp_path, 3, 8))
    for index in range(3):
        truth = folder.labelled(index)
        found = [item for item in baseline.detect(truth.difference) if item.score > 0.9]
        assert len(found) == len(truth.boxes)
        assert sum(item.area_px for item in found) == pytest.approx(
            (truth.labels > 0).sum(), rel=0.15
        )  # closing rounds small niches up


def test_detect_writes_what_it_says(tmp_path):
    make_set(tmp_path / "set", 2, 9)
    out = tmp_path / "out"
    found = detect("baseline", [tmp_path / "set"], out)
    assert len(found) == 6
    assert len(COCO(str(out / "detections_0.9.json")).anns) == 6
    assert len((out / "events_0.9.csv").read_text().splitlines()) == 7
    for name in ("detections.json", "detections_0.99.json", "1_masks.tif", "1_detections.png"):
        assert (out / name).is_file()


def test_the_command_shows_its_progress_and_says_what_it_found(tmp_path, capsys):
    make_set(tmp_path / "set", 1, 9)
    assert main(["detect", "baseline", str(tmp_path / "set"), "--out", str(tmp_path / "out"), "--no-pictures"]) == 0
    assert "3 blocks" in capsys.readouterr().out


def test_inputs_that_are_none_are_refused(tmp_path):
    with pytest.raises(InputError, match="no difference map"):
        find_inputs([tmp_path])
    (tmp_path / "annotations.json").write_text("[1, 2]")
    with pytest.raises(InputError, match="not a COCO annotation file"):
        find_inputs([tmp_path])
    (tmp_path / "annotations.json").write_text(json.dumps({"images": [], "annotations": [], "categories": []}))
    with pytest.raises(InputError, match="the list 'images' is empty"):
        find_inputs([tmp_path])
    (tmp_path / "a.tif").write_bytes(b"II*\0garbage")
    with pytest.raises(InputError, match="TIFF"):
        detect("baseline", [tmp_path / "a.tif"], tmp_path / "out")


def test_a_tiff_of_another_size_than_annotated_is_refused(tmp_path):
    make_set(tmp_path, 1, 9)
    content = json.loads((tmp_path / "annotations.json").read_text())
    content["images"][0]["width"], content["annotations"] = 99, []
    (tmp_path / "annotations.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="128 x 99 px as annotated"):
        CocoFolder(tmp_path).labelled(0)


def test_learning_rate_warms_up_and_falls():
    config = TrainingConfig(learning_rate=0.1, warm_up_steps=9, schedule="cosine")
    assert learning_rate(0, 1000, config) == pytest.approx(0.01, rel=1e-3)
    assert learning_rate(9, 1000, config) == pytest.approx(0.1, rel=1e-3)
    assert learning_rate(1000, 1000, config) == pytest.approx(0.001)


def test_training_stops_where_the_mean_slope_is_flat():
    config = TrainingConfig(stop_window=10, stop_slope=0.01)
    falling = [2.0 - 0.05 * epoch for epoch in range(20)]
    assert not has_converged(falling, config)
    assert has_converged(falling + [falling[-1]] * 10, config)
    assert not has_converged([1.0] * 10, config)  # fewer than the window


def test_the_detector_does_without_the_ray_tracer_and_that_refuses_to_come_second():
    """If Dr.Jit is imported after TensorFlow, it takes TensorFlow's LLVM symbols and crashes; the other order works."""
    modules = "pipeline.detection.products.run, pipeline.detection.training.training, pipeline.detection.products.score_files"
    script = f"""
import sys, {modules}
assert "drjit" not in sys.modules and "tensorflow" in sys.modules
from scene.common.errors import InputError
try:
    import scene.common.backend
except InputError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
    )
    assert "two processes" in done.stdout


class _EverythingIsABlock:
    """A fake network whose only detection is the whole window, even beyond the end of the map."""

    size = 64
    config = DetectorConfig(image_px=64)

    def predict_on_batch(self, inputs):
        count = len(inputs["image"])
        box = np.array([[0, 0, 64, 64]], np.float32)
        answer = {"mask_boxes": box, "scores": np.ones(1, np.float32), "masks": np.ones((1, 28, 28), np.float32)}
        return {name: np.repeat(values[None], count, axis=0) for name, values in answer.items()}


def test_a_mask_ends_where_a_small_map_ends():
    difference = np.random.default_rng(1).normal(0, 0.01, (40, 50)).astype(np.float32)
    (found,) = inference.detect(_EverythingIsABlock(), difference)
    assert (found.row, found.column, found.mask.shape) == (0, 0, (40, 50))
    assert found.annotation(1, 1, difference.shape)["area"] == 40 * 50


def test_what_libraries_write_is_dropped_unless_they_fail(capfd):
    def failing() -> None:
        os.write(2, b"the reason")
        raise ImportError

    with suppress_stderr():
        os.write(2, b"chatter")
    os.write(2, b"between ")
    with pytest.raises(ImportError), suppress_stderr():
        failing()
    assert capfd.readouterr().err == "between the reason"


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("0", "0")])
def test_convolutions_are_onednns_unless_the_environment_says_otherwise(
    given: str | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TF_ENABLE_ONEDNN_OPTS", raising=False)
    if given is not None:
        monkeypatch.setenv("TF_ENABLE_ONEDNN_OPTS", given)
    import_keras()
    assert os.environ["TF_ENABLE_ONEDNN_OPTS"] == expected


def test_maps_of_one_name_are_told_apart(tmp_path: Path) -> None:
    """Maps of two runs: each has its own name in the tables, and its own pictures."""
    values = np.where(np.arange(900).reshape(30, 30) % 31 == 0, 0.5, 0.0).astype(np.float32)
    for name in ("a/difference_001.tif", "b/difference_001.tif", "b/x y.tif", "b/x_y.tif"):
        write_geotiff(tmp_path / name, values, Grid(0.0, 3.0, 0.1, 30, 30))
    places = [tmp_path / "a", tmp_path / "b", tmp_path / "b/x y.tif", tmp_path / "b/x_y.tif"]
    assert [item.name for item in find_inputs(places)] == ["a/difference_001.tif", "b/difference_001.tif", "x y.tif", "x_y.tif"]
    assert [item.image["file_name"] for item in find_inputs(places)][:2] == ["a/difference_001.tif", "b/difference_001.tif"]
    detect("baseline", places, tmp_path / "out")
    stems = ("a_difference_001", "b_difference_001", "x_y", "x_y_2")
    assert {path.name for path in (tmp_path / "out").glob("*_masks.tif")} == {f"{stem}_masks.tif" for stem in stems}
