"""Data sets of time series: labels of what fell since the reference, other changes without, and the same bytes in any order."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from tiny_dataset import TINY, digests, tiny

from pipeline.dataset.combine import merge_datasets
from pipeline.dataset.config import DatasetConfig
from pipeline.dataset.epoch import StageCache, make_epoch
from pipeline.dataset.loaders import Tiles
from pipeline.dataset.plan import planned_epochs
from pipeline.dataset.run import Workers, make_dataset, verify_dataset
from pipeline.detection.network.data import CocoFolder
from pipeline.report.progress import Progress
from scene.common.errors import InputError

pytestmark = pytest.mark.usefixtures("undrawn")

SERIES: dict[str, Any] = {
    "times": {"start": "2026-03-01T00:00:00Z", "every_h": 6, "count": 4},
    "events": [
        {"after_h": 3, "volume_m3": 0.06, "position_m": [2.0, 3.0]},
        {"after_h": 15, "volume_m3": 0.06, "position_m": [6.5, 3.0], "precursor": {"lead_h": 12, "displacement_m": 0.3}},
    ],
    "deposits": {"fragments": 2, "volume_sigma_log": 0.0},
    "conditions": {"pose": {"position_m": {"random_walk": 0.002}}},
}
PART = {"walls": ["ledge"], "noise": ["low"], "sizes": ["large"]}


def config(parts: dict[str, int], **series: Any) -> DatasetConfig:
    wall = {**TINY["walls"]["ledge"], "series": {**SERIES, **series}}
    return tiny(walls={"ledge": wall}, sensors=["tls"], parts=[{**PART, **parts}], validation_region=0)


def annotated(folder: Path) -> dict[int, dict[int, float]]:
    """By number of the epoch and label of the block, the mean true change under its annotations, m."""
    found: dict[int, dict[int, list[float]]] = {}
    for sample in Tiles(folder / "test"):
        assert sample.truth is not None
        step = int(sample.record["file_name"].partition("test0001e")[2][:4])
        for mask, each in zip(sample.masks, sample.annotations, strict=True):
            values = found.setdefault(step, {}).setdefault(10 * each["category_id"] + each["block"], [])
            values += sample.truth[mask & sample.valid].tolist()
    return {step: {key: float(np.nanmedian(each)) for key, each in blocks.items()} for step, blocks in found.items()}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("series") / "set"
    make_dataset(config({"test": 1, "train": 1}), folder)
    return folder


def test_each_epoch_of_a_series_is_planned_once() -> None:
    planned = planned_epochs(config({"train": 2, "val": 1}))
    assert [(each.split, each.number, each.step) for each in planned] == [
        *(("train", number, step) for number in (1, 2) for step in (1, 2, 3)),
        *(("val", 1, step) for step in (1, 2, 3)),
    ]
    assert len({each.name for each in planned}) == 9
    assert "step" not in planned_epochs(tiny())[0].to_dict()


def test_rock_that_has_fallen_is_annotated_in_all_later_epochs_and_nothing_else_is(made: Path) -> None:
    """Block 1 falls before epoch 1; block 2 leans out in epochs 1 and 2 and falls before epoch 3."""
    found = annotated(made)
    assert {step: sorted(blocks) for step, blocks in found.items()} == {1: [11], 2: [11], 3: [11, 12]}
    assert all(value > 0.1 for blocks in found.values() for value in blocks.values())
    leaning = np.concatenate([each.truth[each.valid] for each in Tiles(made / "test") if "e0002" in each.record["file_name"]])
    assert leaning.min() < -0.05  # the moved block is there, without a label
    assert [each["name"] for each in COCO(made / "test/annotations.json").dataset["categories"]] == ["block"]


def test_series_of_different_splits_differ(made: Path) -> None:
    shapes = {
        split: [each["size_m"] for each in json.loads((made / split / "annotations.json").read_text())["annotations"]]
        for split in ("train", "test")
    }
    assert shapes["train"][0] != shapes["test"][0]


def test_an_epoch_is_the_same_without_those_before_it(made: Path) -> None:
    before = digests(made)
    lost = sorted((made / "test").glob("*e0002*.tif"))
    for path in lost:
        path.unlink()
    summary = verify_dataset(made)
    assert len(summary.made) == 1
    assert lost
    assert digests(made) == before


def test_two_workers_make_the_same_bytes(made: Path, tmp_path: Path) -> None:
    """The epochs of a series are divided between the workers, each of which follows the wall from its beginning."""
    pytest.importorskip("distributed")
    pytest.importorskip("cryptography")
    make_dataset(config({"test": 1, "train": 1}), tmp_path / "set", Workers(2))
    assert digests(tmp_path / "set") == digests(made)


def test_going_back_in_a_series_gives_the_same_epoch() -> None:
    settings = config({"test": 1})
    planned, stages = planned_epochs(settings), StageCache(settings)
    last, first, again = (make_epoch(settings, planned[step], stages, Progress()) for step in (2, 0, 2))
    assert first.record["blocks"] == 1
    for one, other in zip(last.tiles, again.tiles, strict=True):
        np.testing.assert_array_equal(one.tile.values, other.tile.values)
    assert stages.made == 1


def test_kinds_are_categories_and_training_takes_the_missing_rock(tmp_path: Path) -> None:
    make_dataset(config({"test": 1}, kinds=True), tmp_path / "set")
    found = annotated(tmp_path / "set")
    assert {step: set(blocks) & {11, 12, 21, 22} for step, blocks in found.items()} == {1: {11, 22}, 2: {11, 22}, 3: {11, 12}}
    assert found[2][22] < -0.05
    assert [each["name"] for each in COCO(tmp_path / "set/test/annotations.json").dataset["categories"]] == [
        "missing",
        "moved",
        "deposit",
    ]
    assert {each["category_id"] for each in CocoFolder(tmp_path / "set/test").annotations} == {1}
    plain = tmp_path / "plain"
    make_dataset(config({"test": 1}), plain)
    with pytest.raises(InputError, match=r"one category, block.*same `series.kinds`"):
        merge_datasets([tmp_path / "set", plain], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


@pytest.mark.parametrize(
    ("walls", "words"),
    [
        ({"ledge": {"kinds": False}, "other": {"kinds": True}}, "walls.ledge and walls.other differ in series.kinds"),
        ({"ledge": {"times": {**SERIES["times"], "count": 10_000}}}, "epochs; allowed: up to 100,000"),
    ],
)
def test_a_config_that_cannot_be_annotated_is_refused(walls: dict[str, Any], words: str) -> None:
    given = {name: {**TINY["walls"]["ledge"], "series": {**SERIES, **changes}} for name, changes in walls.items()}
    with pytest.raises(InputError, match=words):
        tiny(walls=given, noise={"low": {"tls": {"model": {"sensor": "tls"}}}}, sensors=["tls"], parts=[{**PART, "train": 20}])
