"""Maps that are damaged or claim to be huge, in `train` and `detect`: one message, and no incomplete files are left."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_array_equal
from test_model import SIDE, SMALL, make_set

from pipeline.change.annotate import run_length_encoding
from pipeline.cli.main import main
from pipeline.detection.network.config import TrainConfig, TrainingConfig
from pipeline.detection.network.data import CocoFolder, batches
from pipeline.formats.rasters import geotiff
from pipeline.formats.rasters.geotiff import read_geotiff, read_tiff
from scene.common.errors import InputError


def _claiming(path: Path, height: int, width: int) -> Path:
    """Write a file of a few hundred bytes whose header claims an image of this size."""
    tifffile.imwrite(path, np.zeros((64, 64), np.float32), compression="zlib", tile=(64, 64))
    with tifffile.TiffFile(path, mode="r+b") as file:
        tags = file.pages.first.tags
        for name, value in (("ImageLength", height), ("ImageWidth", width)):
            tags[name].overwrite(value, dtype="I")
    assert path.stat().st_size < 2000
    return path


def _cut(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[:-100])
    return path


def test_an_image_that_claims_gigabytes_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(tifffile.TiffPage, "asarray", lambda *_, **__: pytest.fail("it was read"))
    for read in (read_tiff, read_geotiff):
        with pytest.raises(
            InputError, match=r"30000 x 30000 px, which take 3.6 GB of memory; allowed: at most 250,000,000 px; cut the raster"
        ):
            read(_claiming(tmp_path / "bomb.tif", 30000, 30000))


@pytest.mark.parametrize(("most", "fits"), [(64 * 64, True), (64 * 64 - 1, False)])
def test_the_limit_is_where_it_is_said_to_be(tmp_path, monkeypatch, most, fits):
    monkeypatch.setattr(geotiff, "MOST_PIXELS", most)
    path = _claiming(tmp_path / "a.tif", 64, 64)
    if fits:
        assert read_tiff(path).shape == (64, 64)
    else:
        with pytest.raises(InputError, match=r"at most 4,095 px; .* or set the variable SCARPSIM_READ_GB"):
            read_tiff(path)
        monkeypatch.setenv("SCARPSIM_READ_GB", "0.000017")
        assert read_tiff(path).shape == (64, 64)


def _fails(words: list[str], out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main([*words, "--out", str(out)]) == 2
    assert not out.exists()
    message = capsys.readouterr().err.strip()
    assert message.startswith("error: ")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("damage", [_cut, lambda path: path.unlink(), lambda path: _claiming(path, 30000, 30000)])
def test_detect_writes_nothing_where_a_later_map_cannot_be_read(damage, tmp_path, capsys):
    folder = make_set(tmp_path / "set", 3, 5)
    damage(folder / "3.tif")
    for inputs in ([folder], [folder / "1.tif", folder / "3.tif"]):
        assert "3.tif" in _fails(["detect", "baseline", *map(str, inputs), "--quiet"], tmp_path / "out", capsys)


@pytest.mark.parametrize("split", ["train", "val"])
def test_a_tile_that_is_cut_short_stops_a_training_before_it_begins(split, tmp_path, capsys):
    for name in ("train", "val"):
        make_set(tmp_path / "set" / name, 2, 5)
    _cut(tmp_path / "set" / split / "2.tif")
    message = _fails(["train", str(tmp_path / "set"), "--quiet"], tmp_path / "out", capsys)
    assert f"{split}/2.tif: the file is not a complete TIFF file" in message


@pytest.mark.slow
def test_a_training_that_fails_in_its_first_epoch_leaves_nothing(tmp_path, eager):
    """The function is called directly, because the command would read every tile beforehand."""
    from pipeline.detection.training.training import train

    for name in ("train", "val"):
        make_set(tmp_path / "set" / name, 1, 5)
    _cut(tmp_path / "set" / "val" / "1.tif")
    with pytest.raises(InputError, match="complete TIFF"):
        train(tmp_path / "set", TrainConfig(detector=SMALL, training=TrainingConfig(batch=1, epochs=2)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_polygons_reach_the_network_as_run_lengths_do(tmp_path):
    """Rectangles as polygons and as run lengths cover the same pixels, so training sees the same batches."""
    found = []
    for polygons in (False, True):
        folder = make_set(tmp_path, 2, 5)
        content = json.loads((folder / "annotations.json").read_text())
        for each in content["annotations"]:
            x, y, width, height = each["bbox"]
            box = np.ones((height, width), bool)
            outline = [[x, y, x + width, y, x + width, y + height, x, y + height]]
            each["segmentation"] = outline if polygons else run_length_encoding(box, y, x, (SIDE, SIDE))
        (folder / "annotations.json").write_text(json.dumps(content))
        config = TrainingConfig(batch=2, crop_px=64)
        found.append(list(batches(CocoFolder(folder), SMALL, config, 0, learning=True)))
    for one, two in zip(*found, strict=True):
        for name, values in one.items():
            assert_array_equal(values, two[name])
    assert found[0][0]["valid"].sum() > 0
