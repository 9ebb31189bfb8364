"""Data sets: the folder and the libraries that load it, splits that do not overlap, repair, merging, splitting.

Whole, small sets.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import rasterio
from pycocotools.coco import COCO
from shared_outputs import made_once
from tiny_dataset import EPOCHS, ROOT, TINY, digests, tiny, tiny_set

from pipeline.change.tiles import TileConfig
from pipeline.config.bundled import bundled_config
from pipeline.dataset.combine import merge_datasets, split_dataset
from pipeline.dataset.config import load_dataset_config
from pipeline.dataset.epoch import StageCache, make_epoch
from pipeline.dataset.loaders import Tiles
from pipeline.dataset.plan import planned_epochs, simulation_of, tile_region
from pipeline.dataset.records import write_dataset_file
from pipeline.dataset.run import make_dataset, verify_dataset
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.report.progress import Progress
from scene.common.errors import InputError
from scene.geometry.grid import Grid


def entries(folder: Path, split: str, kind: str) -> list[dict[str, Any]]:
    return list(json.loads((folder / split / "annotations.json").read_text())[kind])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "tiny_set", tiny_set)


def test_every_split_loads_in_pycocotools_with_ids_of_its_own(made: Path) -> None:
    image_ids: list[int] = []
    annotation_ids: list[int] = []
    for split in ("train", "val", "test"):
        data_set = COCO(made / split / "annotations.json")
        assert [category["name"] for category in data_set.loadCats(data_set.getCatIds())] == ["block"]
        assert len(data_set.anns) > 0
        image_ids += data_set.getImgIds()
        annotation_ids += data_set.getAnnIds()
        for annotation in data_set.loadAnns(data_set.getAnnIds()):
            mask = data_set.annToMask(annotation)
            assert mask.sum() == annotation["area"] > 0
            rows, columns = np.nonzero(mask)
            x, y = columns.min(), rows.min()
            assert annotation["bbox"] == [x, y, columns.max() - x + 1, rows.max() - y + 1]
            assert annotation["iscrowd"] == 0
    assert sorted(image_ids) == list(range(1, len(image_ids) + 1))
    assert sorted(annotation_ids) == list(range(1, len(annotation_ids) + 1))


def test_the_folder_follows_the_conventions_of_torchvision_and_fiftyone(made: Path) -> None:
    """CocoDetection joins its root and file_name; FiftyOne finds file_name below data_path and requires these keys."""
    content = json.loads((made / "train/annotations.json").read_text())
    assert {"info", "licenses", "categories", "images", "annotations"} <= content.keys()
    for image in content["images"]:
        assert Path(image["file_name"]).name == image["file_name"]
        assert (made / "train" / image["file_name"]).is_file()
        assert {"id", "width", "height"} <= image.keys()
    for annotation in content["annotations"]:
        assert {"id", "image_id", "category_id", "bbox", "area", "iscrowd", "segmentation"} <= annotation.keys()
        assert isinstance(annotation["area"], int)
        assert isinstance(annotation["segmentation"]["counts"], str)


def test_a_tile_has_values_a_mask_and_its_place(made: Path) -> None:
    masked = 0
    for image in entries(made, "train", "images"):
        with rasterio.open(made / "train" / image["file_name"]) as raster:
            values, transform = raster.read(1), raster.transform
            assert raster.dtypes == ("float32",)
            np.testing.assert_array_equal(raster.dataset_mask() > 0, ~np.isnan(values))
        masked += np.isnan(values).sum()
        assert (transform.c, transform.f, transform.a) == pytest.approx((image["x_min_m"], image["y_max_m"], image["gsd_m"]))
        assert image["valid_share"] == pytest.approx(np.mean(~np.isnan(values)), abs=1e-6)
    assert masked


def test_annotations_know_their_blocks(made: Path) -> None:
    for split in ("train", "val", "test"):
        for annotation in entries(made, split, "annotations"):
            assert annotation["wall"] == "ledge"
            assert annotation["noise"] == "low"
            assert annotation["size_class"] == "large"
            assert annotation["seed"] == 3
            assert all(0.4 <= length <= 0.6 for length in annotation["size_m"])
            assert 0 < annotation["volume_m3"] < 0.6**3 * 1.3
            assert 0 < annotation["share_in_tile"] <= 1
            assert annotation["measured_volume_m3"] == pytest.approx(annotation["volume_m3"], rel=0.5, abs=0.01)
            assert annotation["depth_m"] > 0


def test_the_truth_lies_beside_the_noise(made: Path) -> None:
    """Noiseless heights: the sensor's difference departs from them by its noise; outside niches they are exactly 0."""
    for image in entries(made, "test", "images"):
        noisy, place = read_geotiff(made / "test" / image["file_name"])
        truth, place_of_truth = read_geotiff(made / "test" / image["truth_file_name"])
        assert place == place_of_truth
        assert np.nanmedian(np.abs(noisy - truth)) < 0.02
        assert np.mean(truth[~np.isnan(truth)] == 0) > 0.5
        assert np.nanmin(truth) > -1e-4


def test_validation_shares_neither_place_nor_epoch_with_training(made: Path) -> None:
    def boxes(split: str) -> list[tuple[str, float, float]]:
        images = entries(made, split, "images")
        return [(image["sensor"], image["x_min_m"], image["x_min_m"] + 48 * image["gsd_m"]) for image in images]

    for sensor, left, right in boxes("train"):
        for other, first, last in boxes("val"):
            assert sensor != other or right <= first + 1e-9 or last <= left + 1e-9
    epochs = [{image["epoch"] for image in entries(made, split, "images")} for split in ("train", "val", "test")]
    assert sum(map(len, epochs)) == len(set.union(*epochs)) == EPOCHS


@pytest.mark.parametrize(("width", "overlap", "share"), [(3500, 0, 0.43), (3500, 64, 0.3), (200, 0, 0.5), (1024, 100, 0.5)])
def test_regions_keep_apart(width: int, overlap: int, share: float) -> None:
    config = TileConfig(size_px=100, overlap_px=overlap if overlap < 100 else 99)
    grid = Grid(0.0, 0.0, 0.02, width, 500)
    train, val = tile_region("train", share, grid, config), tile_region("val", share, grid, config)
    assert train.end <= val.first
    assert train.first == 0
    with pytest.raises(InputError, match="columns of tiles rounds to none"):
        tile_region("train", 1e-4, grid, config)


def test_the_card_tells_what_is_there(made: Path) -> None:
    text = (made / "README.md").read_text()
    assert "scarpsim dataset tiny.yaml --out DIR" in text
    assert "seed 3" in text
    assert "mitsuba" in text
    for name in ("sizes", "noise", "samples_stereo", "samples_tls"):
        assert f"card/{name}.png" in text
        assert (made / f"card/{name}.png").stat().st_size > 5000
    for line in (made / "checksums.sha256").read_text().splitlines():
        digest, _, name = line.partition("  ")
        assert hashlib.sha256((made / name).read_bytes()).hexdigest() == digest
    listed = {line.partition("  ")[2] for line in (made / "checksums.sha256").read_text().splitlines()}
    assert set(digests(made)) - listed == {"dataset.json", "checksums.sha256"}


def test_an_epoch_does_not_depend_on_those_before_it(made: Path) -> None:
    """The last epoch of each sensor is made alone, with its own stage, and compared with the set's tiles."""
    config = tiny()
    epoch = planned_epochs(config)[-1]
    found = make_epoch(config, epoch, StageCache(config), Progress())
    for each in found.tiles:
        stored, grid = read_geotiff(made / epoch.split / f"{epoch.name}_{each.tile.name}.tif")
        np.testing.assert_array_equal(stored, each.tile.values)
        assert grid == each.tile.grid


def test_a_stage_is_set_up_once_and_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    config = tiny(references=2, sensors=["tls"])
    plan = planned_epochs(config)
    assert [epoch.reference for epoch in plan] == [1, 1, 1, 2]
    stages = StageCache(config)
    for epoch in plan[:3]:
        make_epoch(config, epoch, stages, Progress())
    assert stages.made == 1
    stages.of(plan[3], Progress())
    assert stages.made == 2


def test_damage_is_found_and_made_again(made: Path, tmp_path: Path) -> None:
    before = digests(made)
    made = Path(shutil.copytree(made, tmp_path / "set"))
    tiles = sorted((made / "train").glob("*.tif"))
    tiles[0].write_bytes(tiles[0].read_bytes()[:1000])
    flipped = bytearray(tiles[1].read_bytes())
    flipped[len(flipped) // 2] ^= 1
    tiles[1].write_bytes(flipped)
    tiles[-1].unlink()
    shard = sorted((made / "shards").iterdir())[-1]
    shard.write_text(shard.read_text()[:-100])
    (made / "val/annotations.json").unlink()
    reported = verify_dataset(made, repair=False)
    assert len(reported.damage) == 5
    assert digests(made) != before
    mended = verify_dataset(made)
    assert {damage.file for damage in mended.damage} == {damage.file for damage in reported.damage}
    assert 2 <= len(mended.made) <= 4
    assert digests(made) == before
    assert verify_dataset(made, repair=False).damage == []


def test_sets_merge_and_split(made: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    make_dataset(tiny(seed=4, sensors=["tls"], truth=False), other)
    merged = tmp_path / "merged"
    summary = merge_datasets([made, other], merged)
    for split in ("train", "val", "test"):
        images = entries(merged, split, "images")
        assert summary.images[split] == len(images) == len(entries(made, split, "images")) + len(entries(other, split, "images"))
        assert len({image["file_name"] for image in images}) == len(images)
    ids = [each["id"] for split in ("train", "val", "test") for each in entries(merged, split, "annotations")]
    assert len(set(ids)) == len(ids)
    next((merged / "train").glob("*.tif")).unlink()
    before = digests(merged)
    assert len(verify_dataset(merged).made) == 1, "a merged set knows how its epochs were made"
    assert len(digests(merged)) == len(before) + 1
    parts = split_dataset(merged, tmp_path / "parts", ["sensor"])
    assert sorted(part.folder.name for part in parts) == ["stereo", "tls"]
    tls = Tiles(tmp_path / "parts/tls/train")
    assert {record["sensor"] for record in tls.records} == {"tls"}
    assert len(tls) == sum(image["sensor"] == "tls" for image in entries(merged, "train", "images"))
    with pytest.raises(InputError, match="another of the given sets has the same epochs"):
        merge_datasets([made, made], tmp_path / "twice")
    assert not (tmp_path / "twice").exists()
    with pytest.raises(InputError, match="unknown key 'sensr'"):
        split_dataset(merged, tmp_path / "more", ["sensr"])


def test_numpy_iterator(made: Path) -> None:
    tiles = Tiles(made / "train", sensor="stereo")
    assert len(tiles) == sum(image["sensor"] == "stereo" for image in entries(made, "train", "images"))
    for sample in tiles:
        assert sample.image.dtype == np.float32
        assert sample.image.shape == sample.valid.shape == (48, 48)
        assert (sample.image[~sample.valid] == 0).all()
        assert len(sample.boxes) == len(sample.masks) == len(sample.annotations)
        for mask, box in zip(sample.masks, sample.boxes, strict=True):
            assert np.ptp(np.nonzero(mask)[1]) + 1 == box[2]
            assert np.ptp(np.nonzero(mask)[0]) + 1 == box[3]
        assert sample.truth is not None
    orders = [[sample.record["id"] for sample in tiles.shuffled(seed)] for seed in (1, 1, 2)]
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == sorted(orders[2]) == [record["id"] for record in tiles.records]
    with pytest.raises(InputError, match=r"unknown filter 'noises'; .* did you mean 'noise'"):
        Tiles(made / "train", noises="low")
    with pytest.raises(InputError, match="no tile has"):
        Tiles(made / "train", noise="loud")
    with pytest.raises(InputError, match="name the folder of a split"):
        Tiles(made)


def test_the_loaders_leave_the_simulation_alone() -> None:
    program = (
        "import sys, pipeline.dataset.loaders; raise SystemExit(bool({'mitsuba', 'cv2', 'open3d', 'scipy'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


def test_tensorflow_gets_the_tiles_as_their_signature_says(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of TensorFlow, which takes seconds to load, stands what notes the generator and its signature."""
    given: dict[str, Any] = {}

    def from_generator(generate: Any, output_signature: dict[str, tuple[Any, ...]]) -> SimpleNamespace:
        given.update(samples=list(generate()), signature=output_signature)
        return SimpleNamespace(apply=lambda count: count)

    data = SimpleNamespace(
        Dataset=SimpleNamespace(from_generator=from_generator), experimental=SimpleNamespace(assert_cardinality=int)
    )
    types = {"float32": np.float32, "bool": np.bool_, "int64": np.int64}
    stand_in = SimpleNamespace(TensorSpec=lambda shape, kind: (shape, kind), data=data, **types)
    monkeypatch.setitem(sys.modules, "tensorflow", stand_in)  # type: ignore[arg-type]
    tiles = Tiles(made / "train")
    assert cast("int", tiles.tf_dataset()) == len(tiles) == len(given["samples"])
    for tile, sample in zip(tiles, given["samples"], strict=True):
        assert sample.keys() == given["signature"].keys()
        for name, (shape, kind) in given["signature"].items():
            assert sample[name].dtype == kind
            assert all(known in (None, found) for known, found in zip(shape, sample[name].shape, strict=True))
        np.testing.assert_array_equal(sample["image"][..., 0], tile.image)
        assert sample["image_id"] == tile.record["id"]


def test_tf_data(made: Path) -> None:
    """In a process of its own, because TensorFlow and the ray tracer each bring LLVM.

    TensorFlow reads tiles in several threads, in which PROJ would crash.
    """
    pytest.importorskip("tensorflow")
    program = f"""
import numpy as np
from pipeline.dataset.loaders import Tiles
tiles = Tiles({str(made / "train")!r})
dataset = tiles.tf_dataset()
assert dataset.cardinality() == len(tiles)
for sample, again in zip(tiles, dataset.as_numpy_iterator(), strict=True):
    np.testing.assert_array_equal(sample.image, again["image"][..., 0])
    np.testing.assert_array_equal(sample.valid, again["valid"][..., 0])
    np.testing.assert_array_equal(sample.masks, again["masks"])
    np.testing.assert_array_equal(sample.boxes, again["boxes"])
    assert again["image_id"] == sample.record["id"]
"""
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT, env={**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"})


def test_what_is_not_ours_is_left_alone(made: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="exists and is not empty"):
        make_dataset(tiny(), tmp_path)
    with pytest.raises(InputError, match="but the given config makes the set"):
        make_dataset(tiny(seed=5), made)
    known = json.loads((made / "dataset.json").read_text())
    with pytest.raises(InputError, match="is not a data set"):
        verify_dataset(tmp_path)
    source = next(iter(known["sources"].values()))
    changed = {known["fingerprint"]: {**source, "versions": {**source["versions"], "numpy": "0.1"}}}
    copy = tmp_path / "copy"
    write_dataset_file(copy, known["name"], changed, known["epochs"])
    with pytest.raises(InputError, match=r"started with other versions of packages: numpy 0.1 \(here"):
        make_dataset(tiny(), copy)


def test_a_finished_set_is_a_config(made: Path) -> None:
    assert load_dataset_config(made / "dataset.json") == tiny()
    assert load_dataset_config(made / "dataset.json", ["parts.0.train=5"], 9) == tiny(
        seed=9, parts=[{**TINY["parts"][0], "train": 5}]
    )


@pytest.mark.parametrize("name", ["rockfall_9", "small"])
def test_bundled_sets(name: str) -> None:
    config = load_dataset_config(bundled_config("datasets", name))
    plan = planned_epochs(config)
    assert len({epoch.name for epoch in plan}) == len(plan)
    assert [epoch.index for epoch in plan] == list(range(len(plan)))
    stages = [epoch.stage for epoch in plan]
    assert sum(a != b for a, b in pairwise(stages)) + 1 == len(set(stages)), "each stage is set up once"


def test_the_thesis_matrix() -> None:
    config = load_dataset_config(bundled_config("datasets", "rockfall_9"))
    plan = planned_epochs(config)
    sets = {(epoch.noise, epoch.size) for epoch in plan if epoch.split == "train"}
    assert len(sets) == 9
    assert {epoch.sensor for epoch in plan} == {"stereo", "tls"}
    epochs = [epoch for epoch in plan if (epoch.sensor, epoch.noise, epoch.size) == ("stereo", "low", "small")]
    tiles = {"train": 4 * 3, "val": 3 * 3}  # of 7 x 2.9 on 3500 x 1500 px
    counts = {split: sum(tiles[split] for epoch in epochs if epoch.split == split) for split in tiles}
    assert 1600 <= sum(counts.values()) <= 1800
    assert counts["val"] / sum(counts.values()) == pytest.approx(0.2, abs=0.005)
    walls = [epoch.wall for epoch in epochs]
    assert walls.count("glendale") == walls.count("bulga")
    assert len({epoch.wall for epoch in plan if epoch.split == "test"}) == 4
    high, medium, low = (config.noise[level].stereo for level in ("high", "medium", "low"))
    assert high is not None
    assert medium is not None
    assert low is not None
    ratio = medium.on("bulga").noise.parallax_sigma_px / high.on("bulga").noise.parallax_sigma_px  # type: ignore[union-attr]
    assert ratio == pytest.approx(0.66, abs=1e-3)


def test_noise_is_scaled_and_its_grid_is_not() -> None:
    config = load_dataset_config(bundled_config("datasets", "rockfall_9"))
    level = config.noise["5cm"].stereo
    assert level is not None
    scaled, plain = level.on("bismantova").noise.model_dump(), level.model.noise.model_dump()
    factor = level.scale["bismantova"]  # type: ignore[index]
    assert scaled["parallax_sigma_px"] == plain["parallax_sigma_px"] < 1  # the orientation alone is scaled
    assert scaled["orientation"]["cx_px"]["sigma"] == pytest.approx(factor * plain["orientation"]["cx_px"]["sigma"])
    assert scaled["regularization_step_px"] == plain["regularization_step_px"]
    epoch = next(each for each in planned_epochs(config) if (each.noise, each.wall) == ("5cm", "bismantova"))
    assert simulation_of(config, epoch).stereo_model() == level.on("bismantova")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise": {}}, "'noise'"),
        ({"parts": [{"walls": ["ledg"], "noise": ["low"], "sizes": ["large"], "train": 1}]}, "did you mean 'ledge'"),
        ({"parts": [{"walls": ["ledge"], "noise": ["low"], "sizes": ["large"]}]}, "has no epochs"),
        ({"parts": [TINY["parts"][0], TINY["parts"][0]]}, "repeats the combination"),
        ({"noise": {"low": {"stereo": TINY["noise"]["low"]["stereo"]}}}, "needs noise.low.tls"),
        ({"noise": {"low": {**TINY["noise"]["low"], "tls": {"model": {"sensor": "tls"}, "scale": {"x": 1}}}}}, "no factor"),
        ({"walls": {"a_b": TINY["walls"]["ledge"]}}, "a_b"),
        ({"tilez": {}}, "did you mean 'tiles'"),
    ],
)
def test_mistakes_in_the_config(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        tiny(**changes)


def test_blocks_that_do_not_fit_name_the_epoch(tmp_path: Path) -> None:
    sizes = {"large": {"blocks_per_m2": 0.1, "rockfall": {"size_m": 20.0}}}
    with pytest.raises(InputError, match=r"ledge_tls_low_large_train0001: .*size_m: .* are larger than the wall"):
        make_dataset(tiny(sizes=sizes, sensors=["tls"]), tmp_path / "set")
